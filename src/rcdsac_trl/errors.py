"""The exceptions whose message is the sentence a user reads: wrong input, and work that cannot go on."""


def _on_one_line(sentence: str) -> str:
    """Write out what would break a line or steer a terminal: values and names may hold anything."""
    return "".join(char if char.isprintable() else char.encode("unicode_escape").decode("ascii") for char in sentence)


def first_line(error: BaseException) -> str:
    """Return the first line of what an engine says of an error, or the error's name if it says nothing."""
    return (str(error).strip().splitlines() or [type(error).__name__])[0]


class UserInputError(ValueError):
    """Wrong input from a user.

    The message is one sentence that names the value, the limit and the remedy. Entry points print it and
    exit with code 2, before work starts and before anything is written.

    Example:
        >>> print(UserInputError("seed=\\n must be a whole number"))
        seed=\\n must be a whole number
    """

    def __init__(self, sentence: str) -> None:
        super().__init__(_on_one_line(sentence))


class FaultError(RuntimeError):
    """Work that cannot go on, through no fault of the input.

    The message is one sentence that says what happened and where to look. Entry points print it and exit with code 1.
    """

    def __init__(self, sentence: str) -> None:
        super().__init__(_on_one_line(sentence))


class TrainingError(FaultError):
    """A training that cannot go on; its last checkpoint is what it was."""
