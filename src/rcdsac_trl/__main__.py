"""All verbs as one command: ``rcdsac-trl <verb> key=value ..``, which is also ``python -m rcdsac_trl <verb> ..``."""

import sys
from importlib import import_module

import rcdsac_trl
from rcdsac_trl.cli import fail
from rcdsac_trl.config.completion import bash_completion
from rcdsac_trl.config.verb_help import list_of_verbs
from rcdsac_trl.config.verbs import module_of, verb_named
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.system.runtime import speak_anywhere


def main() -> None:
    """Do what the first word says; without one, list what there is."""
    speak_anywhere()
    first, *arguments = sys.argv[1:] or ["--help"]
    try:
        if first in ("--help", "-h", "help"):
            print(list_of_verbs())
        elif first == "--version":
            print(f"rcdsac_trl {rcdsac_trl.__version__}")
        elif first == "--completion":
            print(bash_completion(), end="")
        elif first.startswith("-") or "=" in first:
            raise UserInputError(f"{first} is no verb: begin with one, as in `rcdsac-trl train +algo=rcdsac_pow`")
        else:
            verb = verb_named(first)
            sys.argv = [f"rcdsac-trl {verb}", *arguments]
            import_module(module_of(verb)).main()
    except UserInputError as error:
        fail(error)


if __name__ == "__main__":
    main()
