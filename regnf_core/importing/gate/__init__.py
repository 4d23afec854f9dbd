"""The import gate: a throw-away process that turns an upload into a regnf field file."""
