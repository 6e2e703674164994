"""Maps of several kinds: an agent that has driven one kind alone knows no other."""

from collections.abc import Mapping
from dataclasses import dataclass

from rcdsac_trl.errors import UserInputError
from rcdsac_trl.seeding import stream
from rcdsac_trl.world.maps.generator import MapSettings, Split


@dataclass(frozen=True)
class MapMixture:
    """Map sets that take turns; every field is a key of ``conf/map/varied.yaml``.

    Of as many successive maps as there are sets one is of each, in an order that the seed draws.

    Attributes:
        families: name of each set, and what its maps are drawn from.

    Raises:
        UserInputError: there is none.

    Example:
        >>> mixture = MapMixture({"calm": MapSettings(num_movers=0), "busy": MapSettings(num_movers=8)})
        >>> sorted(mixture.family_of("train", seed=0, index=index) for index in (4, 5))
        ['busy', 'calm']
    """

    families: Mapping[str, MapSettings]

    def __post_init__(self) -> None:
        """Refuse what no map can be drawn from."""
        if not self.families:
            raise UserInputError("map.families is empty: name a map set, such as mixed")

    def __eq__(self, other: object) -> bool:
        """Compare the sets in their order, which says what is on a map; dicts compare without it."""
        if not isinstance(other, MapMixture):
            return NotImplemented
        return tuple(self.families.items()) == tuple(other.families.items())

    def __hash__(self) -> int:
        """Make it a key, as other sources of maps are: maps are kept by what they are made from."""
        return hash(tuple(self.families.items()))

    def family_of(self, split: Split, seed: int, index: int) -> str:
        """Return the name of the set that a map is of.

        Args:
            split: which of the disjoint families of maps.
            seed: the root seed.
            index: the map's number.
        """
        turn, place = divmod(index, len(self.families))
        order = stream(seed, f"map families/{split}", turn).permutation(len(self.families))
        return list(self.families)[order[place]]
