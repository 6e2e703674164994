"""What may be chosen of what collects the episodes (``conf/collector``), checked."""

from dataclasses import dataclass
from typing import Literal

from rcdsac_trl.errors import UserInputError
from rcdsac_trl.system.processes import resolve_processes


@dataclass(frozen=True)
class SlurmSettings:
    """The SLURM jobs of ``collector=distributed``."""

    partition: str | None
    timeout_min: int

    def __post_init__(self) -> None:
        """Refuse what is below 1."""
        if self.timeout_min < 1:
            raise UserInputError(f"collector.slurm.timeout_min={self.timeout_min} must be at least 1")


@dataclass(frozen=True)
class CollectorSettings:
    """What collects the episodes (``conf/collector``)."""

    name: Literal["multi", "single", "ray", "distributed"]
    num_processes: int | Literal["auto"] = 0
    address: str | None = None
    slurm: SlurmSettings | None = None

    def __post_init__(self) -> None:
        """Refuse processes that there cannot be, and what does nothing."""
        resolve_processes(self.num_processes, 1, "collector.num_processes")
        if self.name == "single" and self.num_processes != 0:
            raise UserInputError(
                f"collector.num_processes={self.num_processes} does nothing with collector=single: give "
                "world.num_workers, or take collector=multi"
            )
        if self.shares_evenly and self.num_processes == 0:
            raise UserInputError(
                f"collector.num_processes=0 leaves collector={self.name} nothing to do: give 1 or more, or auto"
            )
        if self.name != "ray" and self.address is not None:
            raise UserInputError(
                f"collector.address={self.address} does nothing with collector={self.name}: take collector=ray"
            )
        if self.name != "distributed" and self.slurm is not None:
            raise UserInputError(f"collector.slurm does nothing with collector={self.name}: take collector=distributed")
        if self.slurm is not None and self.num_processes == "auto":
            raise UserInputError(
                "collector.num_processes=auto counts the cores of this machine, not SLURM's: say how many jobs"
            )

    @property
    def shares_evenly(self) -> bool:
        """Whether TorchRL puts the episodes together, which then must be as many from each process."""
        return self.name in ("ray", "distributed")

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
