"""Names that users give to objects, fields and detections."""

LABEL_PATTERN = r"^[^\x00-\x1f\x7f\u202a-\u202e\u2066-\u2069]*$"
"""Labels are shown as they are: no control characters, and none that turn the text around them."""
