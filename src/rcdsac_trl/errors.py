"""The exceptions whose message is the sentence a user reads: wrong input, and work that cannot go on."""


class UserInputError(ValueError):
    """Wrong input from a user.

    The message is one sentence that names the value, the limit and the remedy. Entry points print it and
    exit with code 2, before work starts and before anything is written.
    """


class FaultError(RuntimeError):
    """Work that cannot go on, through no fault of the input.

    The message is one sentence that says what happened and where to look. Entry points print it and exit with code 1.
    """


class TrainingError(FaultError):
    """A training that cannot go on; its last checkpoint is what it was."""
