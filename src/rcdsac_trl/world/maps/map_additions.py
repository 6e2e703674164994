"""What generated maps and maps of files have in common: movers and margins, their limits, and how movers are drawn."""

from typing import TYPE_CHECKING

import numpy as np

from rcdsac_trl.world.maps.map_checks import check_number, check_range, check_whole
from rcdsac_trl.world.maps.shapes import Mover

if TYPE_CHECKING:  # both of its kinds import this
    from rcdsac_trl.world.maps.files.file_map import FileMapSettings
    from rcdsac_trl.world.maps.generator import MapSettings


def check_additions(settings: "MapSettings | FileMapSettings", section: str = "") -> None:
    """Refuse movers and margins that no map can be made with.

    Args:
        settings: of the maps.
        section: what names of keys begin with, such as ``"map."``.

    Raises:
        UserInputError: naming the key and its limits.
    """
    check_whole(f"{section}num_movers", settings.num_movers, 0, 50)
    check_range(f"{section}mover_radius_m", settings.mover_radius_m, 0.05, 0.4)
    check_range(f"{section}mover_speed_m_per_s", settings.mover_speed_m_per_s, 0.05, 2.0)
    check_number(f"{section}yielding_fraction", settings.yielding_fraction, 0.0, 1.0)
    check_number(f"{section}clearance_margin_m", settings.clearance_margin_m, 0.02, 0.2)
    check_number(f"{section}waypoint_clearance_m", settings.waypoint_clearance_m, 0.0, 2.0)
    check_number(f"{section}detour_m", settings.detour_m, 0.2, 3.0)


def draw_movers(settings: "MapSettings | FileMapSettings", rng: np.random.Generator) -> tuple[Mover, ...]:
    """Draw the sizes and top speeds of the movers, and who of them yields where not all do."""
    return tuple(
        Mover(
            float(rng.uniform(*settings.mover_radius_m)),
            float(rng.uniform(*settings.mover_speed_m_per_s)),
            settings.yielding_fraction == 1.0 or bool(rng.random() < settings.yielding_fraction),
        )
        for _ in range(settings.num_movers)
    )
