"""What the verb ``play`` makes of its config: what is offered, and the server."""

from dataclasses import dataclass
from pathlib import Path

from omegaconf import DictConfig

from rcdsac_trl.config.named_world import generated_sets, map_set
from rcdsac_trl.config.play_settings import PlaySettings
from rcdsac_trl.config.run_config import read_config
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.playground.offers import Offers
from rcdsac_trl.playground.play_server import PlayServer, is_loopback, what_it_means
from rcdsac_trl.system.progress import serving
from rcdsac_trl.world.maps.files.file_map import FileMapSettings


@dataclass(frozen=True)
class PlaySession:
    """A server that is yet to listen."""

    settings: PlaySettings
    offers: Offers

    def run(self) -> None:
        """Serve until Ctrl-C."""
        settings = self.settings
        server = serve(self.offers, settings)
        print(f"{server.address} drives {', '.join(self.offers.drivers)}; Ctrl-C ends it")
        if (warning := what_it_means(settings.host, server.port)) is not None:
            print(warning)
        with serving():
            server.run(browser=settings.browser and is_loopback(settings.host))


def make_session(cfg: DictConfig) -> PlaySession:
    """Read what is offered.

    Raises:
        UserInputError: for an agent or a map that cannot be read, and a name that stands for two.
    """
    settings = read_config(cfg, PlaySettings)
    return PlaySession(settings, offers_of(settings))


def offers_of(settings: PlaySettings) -> Offers:
    """Return agents and maps that settings name, with the map sets of ``conf/map/``."""
    sets = {name: map_set(name) for name in generated_sets()}
    files: dict[str, FileMapSettings] = {}
    for path in settings.maps:
        name = Path(path).stem
        if name in files:
            raise UserInputError(f"two maps are called {name}: rename the file of one of them")
        files[name] = FileMapSettings(path=path)
    return Offers.of(settings.runs, dict(sorted(sets.items(), key=lambda item: item[0] != "mixed")), files)


def serve(offers: Offers, settings: PlaySettings) -> PlayServer:
    """Listen as settings say."""
    return PlayServer(
        offers,
        host=settings.host,
        port=settings.port,
        origins=settings.origins,
        max_sessions=settings.max_sessions,
        films=Path(settings.films),
    )
