"""Errors that the command line reports in one line."""


class Refusal(Exception):
    """Input that cannot be used; the message is for the user."""


class Diverged(ArithmeticError):
    """Something learnt is no longer finite."""


class Incomplete(Exception):
    """A sweep of which some runs failed."""


class Disagreement(ArithmeticError):
    """A replay gave something else than the run."""
