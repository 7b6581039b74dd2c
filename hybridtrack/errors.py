"""The one exception that a user's mistake raises: a sentence with its remedy, exit code 2."""


class UserError(Exception):
    """Bad input. `str(error)` is one clear sentence that names the value and the remedy."""


class Stopped(Exception):
    """A block gave up because the run is being stopped."""
