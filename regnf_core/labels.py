"""Names and numbers as people see them, and what of any text must not reach a line of a log."""

UNSHOWN = r"\x00-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ufeff\ufff9-\ufffb"
"""Characters of control, of line breaks and of the direction of writing, as ranges of a regular expression."""
LABEL_PATTERN = rf"^[^{UNSHOWN}]*$"
"""Labels are shown as they are: nothing in them breaks a line or turns the text around them."""
MOST_OF_LABEL = 200
"""Characters."""


def shown_path(path: str) -> str:
    """The path of a file in a run or an archive; of a very long one, the end."""
    return path if len(path) <= MOST_OF_LABEL else f"...{path[-MOST_OF_LABEL:]}"


def shown_number(value: float) -> str:
    """A number as people read it: four digits, and of a large one, such as a coordinate in UTM, three decimals."""
    return f"{value:.4g}" if not 1e4 <= abs(value) < 1e12 else f"{value:.3f}".rstrip("0").rstrip(".")
