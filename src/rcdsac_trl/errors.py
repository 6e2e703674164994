"""The one exception for wrong input: its message is the sentence a user reads."""


class UserInputError(ValueError):
    """Wrong input from a user.

    The message is one sentence that names the value, the limit and the remedy. Entry points print it and
    exit with code 2, before work starts and before anything is written.
    """
