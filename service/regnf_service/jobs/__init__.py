"""Registration jobs at the front end: from a request to a job id, and from a job to its result."""
