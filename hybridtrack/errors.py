"""The one exception that a user's mistake raises: a sentence with its remedy, exit code 2."""


class UserError(Exception):
    """Bad input. `str(error)` is one clear sentence that names the value and the remedy."""


class Unsuited(UserError):
    """A scenario that is right, but not for what is asked of it; `keys` lead to what is in the way.

    The sentence names neither file nor line: whoever read the scenario adds them.
    """

    def __init__(self, sentence: str, *keys: str | int) -> None:
        super().__init__(sentence)
        self.keys = keys


class Stopped(Exception):
    """A block gave up because the run is being stopped."""
