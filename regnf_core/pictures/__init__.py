"""Pictures of fields and of clouds, and the small renderer behind them. Loads little: the import gate draws too."""
