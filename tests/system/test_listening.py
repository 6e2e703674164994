"""Addresses that nothing can listen on are refused with what to choose instead."""

import socket

import pytest

from rcdsac_trl.errors import UserInputError
from rcdsac_trl.system.listening import cannot_listen, check_can_listen


def test_a_free_port_is_let_through_and_one_in_use_is_named_once() -> None:
    check_can_listen("127.0.0.1", 0)
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(UserInputError, match=rf"^port={port} on host=127.0.0.1 is in use: .* port=0") as told:
            check_can_listen("127.0.0.1", port)
    assert str(told.value).count("127.0.0.1") == 1


@pytest.mark.parametrize("host", ["192.0.2.1", "no-such-name.invalid", "::2", "a b"])
def test_an_address_of_elsewhere_is_refused(host: str) -> None:
    with pytest.raises(UserInputError, match=f"^host={host} is no address of this machine \\(.+\\): use localhost"):
        check_can_listen(host, 0)


def test_a_port_of_the_administrator_is_told_so() -> None:
    assert "from 1024 on" in str(cannot_listen("localhost", 80, PermissionError(13, "Permission denied")))
