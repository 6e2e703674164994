"""The page in a notebook."""

from functools import cache
from pathlib import Path
from typing import Any
from urllib.parse import urlencode

from rcdsac_trl.config.compose import compose
from rcdsac_trl.config.play_settings import PlaySettings
from rcdsac_trl.config.run_config import read_config
from rcdsac_trl.deploy import shipped_names
from rcdsac_trl.playground.play_server import PlayServer, in_thread
from rcdsac_trl.playground.play_session import offers_of, serve

_HEIGHT_PX = 880


def show(agent: str, **scene: Any) -> Any:
    """Show a robot that drives while one turns beta: the page of ``python -m rcdsac_trl.play``, below a cell.

    The first call starts a server in a thread of the notebook's kernel, which ends with it. It listens on the loopback:
    a browser on another machine sees it through a tunnel alone.

    Args:
        agent: run folder, exported folder, or shipped agent.
        scene: further keys of :class:`~rcdsac_trl.playground.scene_choice.SceneChoice`, such as ``beta=-1.0``.

    Returns:
        An ``IFrame``, which a notebook shows.

    Raises:
        UserInputError: if there is no such agent.
    """
    from IPython.display import IFrame  # a notebook has it

    shipped = agent in shipped_names()
    server = _server(None if shipped else agent)
    query = urlencode({"agent": agent if shipped else Path(agent).resolve().name, **scene})
    return IFrame(f"{server.address}?{query}", width="100%", height=_HEIGHT_PX)


@cache
def _server(run: str | None) -> PlayServer:
    settings = read_config(compose("play", ["port=0", "browser=false"]), PlaySettings)
    offers = offers_of(settings if run is None else PlaySettings(**(vars(settings) | {"run": run})))
    serving = in_thread(lambda: serve(offers, settings))
    server = serving.__enter__()  # until the kernel ends
    _kept.append(serving)
    return server


# What holds the servers' threads.
_kept: list[Any] = []
