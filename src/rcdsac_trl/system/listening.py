"""Whether a server may listen where it is told to; asked before anything is loaded for it."""

import errno
import os
import socket

from rcdsac_trl.errors import UserInputError


def check_can_listen(host: str, port: int) -> None:
    """Refuse an address that nothing can listen on.

    Args:
        host: name or address.
        port: likewise; 0 for any that is free.

    Raises:
        UserInputError: saying why, and what to choose instead.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        socket.create_server((host, port), family=family).close()
    except OSError as error:
        raise cannot_listen(host, port, error) from None


def cannot_listen(host: str, port: int, error: OSError) -> UserInputError:
    """Return what to say of an address that nothing can listen on.

    Example:
        >>> str(cannot_listen("localhost", 80, PermissionError(errno.EACCES, "")))
        'port=80 is kept for the administrator: choose one from 1024 on, or port=0 for any that is free'
    """
    if error.errno == errno.EADDRINUSE:
        return UserInputError(
            f"port={port} on host={host} is in use: choose another one, or port=0 for any that is free"
        )
    if error.errno == errno.EACCES:
        return UserInputError(
            f"port={port} is kept for the administrator: choose one from 1024 on, or port=0 for any that is free"
        )
    # What looks names up has numbers of its own; else the text may repeat the address.
    why = error.strerror if isinstance(error, socket.gaierror) else os.strerror(error.errno or 0)
    return UserInputError(f"host={host} is no address of this machine ({why}): use localhost, or one that it has")
