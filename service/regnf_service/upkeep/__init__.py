"""What runs beside the requests: lost jobs, retention, leadership."""
