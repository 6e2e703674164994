"""What an export, or a publication, may choose: the roots of their files in ``conf/``."""

from dataclasses import dataclass

from rcdsac_trl.config.acting_override import ActingOverride
from rcdsac_trl.config.checkpoint_name import CheckpointName
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.system.checks import check_least


@dataclass(frozen=True)
class ExportSettings:
    """The root of ``conf/export.yaml``."""

    run: str | None
    checkpoint: CheckpointName | None
    out: str | None
    calibration: str | None
    num_quantiles: int
    acting: ActingOverride

    def __post_init__(self) -> None:
        """Refuse an export of nothing."""
        if self.run is None:
            raise UserInputError("name what to export: run=<folder>, or a shipped agent")
        check_least("num_quantiles", self.num_quantiles, 1)


@dataclass(frozen=True)
class PublishSettings:
    """The root of ``conf/publish.yaml``."""

    runs: tuple[str, ...]
    checkpoint: CheckpointName
    acting: ActingOverride
    weights: str
    results: str

    def __post_init__(self) -> None:
        """Refuse a publication of nothing."""
        if not self.runs:
            raise UserInputError("name what to publish: runs=[<folder>,..]")
