"""Maps from files against the default map: seconds to read one, and environment steps a second side by side.

The map is drawn here, 50 x 50 m of rooms at 5 cm, ragged as mapping leaves walls; `--map` names another. Blocks
of both environments alternate, each with 10 agents and 4 movers that noisy pursuit drives; resets are timed too.
"""

import tempfile
from pathlib import Path
from typing import Any

import bench_world as bench

SIDE_M, CELL_M = 50.0, 0.05
ROOM_M, WALL_M, DOOR_M = 6.25, 0.2, 1.2
SCATTER = 0.3


def main() -> None:
    parser = bench.parser(__doc__)
    parser.add_argument("--map", help="a file to read instead, such as a YAML file of map_server")
    parser.add_argument("--side-m", type=float, default=SIDE_M, help="side of the map that is drawn here, m")
    parser.add_argument("--repeats", type=int, default=5, help="blocks of each environment")
    parser.add_argument("--steps", type=int, default=400, help="agent steps in a block, after its reset")
    options = parser.parse_args()
    bench.prepare()
    from rcdsac_trl.world.maps.files.file_map import FileMapSettings, read_building
    from rcdsac_trl.world.maps.files.map_files import map_files
    from rcdsac_trl.world.maps.generator import MapSettings
    from rcdsac_trl.world.maps.planner import Planner
    from rcdsac_trl.world.task.env import NavigationEnv

    with tempfile.TemporaryDirectory() as folder:
        path = options.map or str(drawn(Path(folder), options.side_m))
        settings = FileMapSettings(path=path, num_movers=4)
        read_building(settings, map_files(path)[0])  # what is compiled is compiled now
        read_building.cache_clear()
        read = {}
        load_s = bench.wall_seconds(lambda: read.update(building=read_building(settings, map_files(path)[0])))
        building, floor = read["building"]
        planner_s = bench.wall_seconds(lambda: Planner(building))
        envs = {
            name: NavigationEnv(map_settings=maps, agent_ids=range(bench.NUM_AGENTS), sensor="narrow")
            for name, maps in (("default", MapSettings()), ("file", settings))
        }
        for env in envs.values():
            env.reset()
            driven(env, 0, 20)
        step_s: dict[str, list[float]] = {name: [] for name in envs}
        reset_s: dict[str, list[float]] = {name: [] for name in envs}
        for block in range(options.repeats):
            for name, env in envs.items():
                reset_s[name].append(bench.cpu_seconds(lambda env=env, block=block: env.reset(episode=block + 1)))
                step_s[name].append(
                    bench.cpu_seconds(lambda env=env, block=block: driven(env, block + 1, options.steps))
                )
        for env in envs.values():
            env.close()
    ratios = [default / file for default, file in zip(step_s["default"], step_s["file"], strict=True)]
    bench.report(
        {
            "boxes": len(building.boxes),
            "cylinders": len(building.cylinders),
            "side_m": building.size_m,
            "floor_m2": floor.area_m2,
            "read_seconds": load_s,
            "planner_seconds": planner_s,
            "reset_seconds_file": bench.middle(reset_s["file"]),
            "reset_seconds_default": bench.middle(reset_s["default"]),
            "step_rate_of_default": bench.middle(ratios),
            "step_rate_of_default_least": min(ratios),
            "step_rate_of_default_most": max(ratios),
        },
        options,
    )


def drawn(folder: Path, side_m: float) -> Path:
    """Write a building of square rooms with a door in every wall, its walls ragged by a cell."""
    import numpy as np
    import yaml
    from PIL import Image

    rng = np.random.default_rng(0)
    cells = round(side_m / CELL_M)
    wall, room, door = (round(length_m / CELL_M) for length_m in (WALL_M, ROOM_M, DOOR_M))
    occupied = np.zeros((cells, cells), bool)
    for at in range(room, cells - wall, room):
        occupied[at : at + wall] = occupied[:, at : at + wall] = True
    for at in range(room, cells - wall, room):
        for other in range(0, cells - room + 1, room):
            middle = other + wall + int(rng.integers(0, room - wall - door))
            occupied[at : at + wall, middle : middle + door] = False
            occupied[middle : middle + door, at : at + wall] = False
    beside = np.zeros_like(occupied)
    for axis in (0, 1):
        for shift in (-1, 1):
            beside |= np.roll(occupied, shift, axis)
    occupied |= beside & (rng.random(occupied.shape) < SCATTER)
    Image.fromarray(np.where(occupied, 0, 254).astype(np.uint8)).save(folder / "rooms.pgm")
    header = {"image": "rooms.pgm", "resolution": CELL_M, "origin": [0.0, 0.0, 0.0], "negate": 0}
    (folder / "rooms.yaml").write_text(yaml.safe_dump(header))
    return folder / "rooms.yaml"


def driven(env: Any, episode: int, steps: int) -> None:
    """Drive by noisy pursuit from where the environment is."""
    import torch

    from rcdsac_trl.rollout.planners.pursuit import pursuit_action
    from rcdsac_trl.seeding import torch_stream

    generator = torch_stream(0, "bench", episode)
    agents = env.agents
    for _ in range(steps):
        noise = 0.7 * torch.randn(len(agents), 2, generator=generator)
        action = pursuit_action(torch.from_numpy(agents.buffers.waypoint)) + noise
        agents.step(action.clamp(-1.0, 1.0).numpy())


if __name__ == "__main__":
    main()
