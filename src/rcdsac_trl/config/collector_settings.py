"""What may be chosen of what collects the episodes (``conf/collector``), checked."""

from dataclasses import dataclass
from typing import Literal

from rcdsac_trl.errors import UserInputError
from rcdsac_trl.system.extras import needs
from rcdsac_trl.system.processes import resolve_processes

BY_TORCHRL = ("parallel_env", "single")
"""The collectors whose environment TorchRL steps, in the process of the learner."""


@dataclass(frozen=True)
class CollectorSettings:
    """What collects the episodes (``conf/collector``)."""

    name: Literal["multi", "parallel_env", "single", "ray"]
    num_processes: int | Literal["auto"] = 0
    address: str | None = None

    def __post_init__(self) -> None:
        """Refuse processes that there cannot be, and what does nothing."""
        resolve_processes(self.num_processes, 1, "collector.num_processes")
        if self.name in BY_TORCHRL and self.num_processes != 0:
            raise UserInputError(
                f"collector.num_processes={self.num_processes} does nothing with collector={self.name}: give "
                "world.num_workers with collector=parallel_env, or take collector=multi"
            )
        if self.shares_evenly and self.num_processes == 0:
            raise UserInputError(
                f"collector.num_processes=0 leaves collector={self.name} nothing to do: give 1 or more, or auto"
            )
        if self.name != "ray" and self.address is not None:
            raise UserInputError(
                f"collector.address={self.address} does nothing with collector={self.name}: take collector=ray"
            )

    @property
    def shares_evenly(self) -> bool:
        """Whether TorchRL puts the episodes together, which then must be as many from each process."""
        return self.name == "ray"

    def check_package(self) -> None:
        """Refuse a collector whose package is missing, in a training; other work on its run needs none.

        Raises:
            UserInputError: if it is.
        """
        if self.name == "ray":
            needs("ray", "collector=ray", extra="ray", instead="collector=multi")

    def check_workers(self, num_workers: int | Literal["auto"]) -> None:
        """Refuse workers of a ``ParallelEnv`` where there is none, and a ``ParallelEnv`` without workers.

        Raises:
            UserInputError: with the collector that goes with the number.
        """
        if self.name not in BY_TORCHRL and num_workers != 0:
            raise UserInputError(
                f"world.num_workers={num_workers} does nothing with collector={self.name}: give "
                "collector.num_processes, or take collector=parallel_env"
            )
        if self.name == "parallel_env" and num_workers == 0:
            raise UserInputError(
                "world.num_workers=0 leaves collector=parallel_env without workers: give 1 or more, or auto, or take "
                "collector=single"
            )

    def check_agents(self, num_agents: int) -> None:
        """Refuse processes that cannot share the agents evenly, where they must.

        Raises:
            UserInputError: if they cannot.
        """
        if self.shares_evenly and self.num_processes != "auto" and num_agents % self.num_processes:
            raise UserInputError(
                f"collector.num_processes={self.num_processes} cannot share world.num_agents={num_agents} evenly: "
                "give a divisor, or auto"
            )


SINGLE = CollectorSettings("single")
"""TorchRL's own collector, in the process of the learner."""
