"""Numbers as the sojourn analysis writes them, in tables and sentences alike."""

FEWEST_DIGITS = 4
MOST_DIGITS = 17  # as many as tell any two floats apart
LARGEST_WRITTEN_OUT = 1e9


def number(value: float, *others: float) -> str:
    """Four digits, or as many as tell it from the others; whole up to 1e9: 17.71, 10001, 1e+12."""
    digits = FEWEST_DIGITS
    while digits < MOST_DIGITS and any(
        f"{value:.{digits}g}" == f"{other:.{digits}g}" for other in others if other != value
    ):
        digits += 1
    text = f"{value:.{digits}g}"
    if "e" in text and 1.0 <= abs(value) < LARGEST_WRITTEN_OUT:
        return f"{value:.0f}"
    return text


def as_set(value: float) -> str:
    """A number that was set, with every digit it has."""
    short = f"{value:g}"
    return short if float(short) == value else str(value)
