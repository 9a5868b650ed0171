"""Frame and unit of the files that an object was read from: how what is defined beside them gets to scene units."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float


@dataclass(frozen=True, eq=False)
class SourceFrame:
    """Frame of an object's own files, and the true size of a scene unit.

    Attributes:
        T_scene_source: similarity from the files' coordinates to the scene's.
        unit_m: metres per scene unit; None where the object's true size is not known.
    """

    T_scene_source: Float[np.ndarray, "4 4"]
    unit_m: float | None

    @property
    def scale(self) -> float:
        """Scene units per unit of the files."""
        return float(np.cbrt(np.linalg.det(self.T_scene_source[:3, :3])))

    @property
    def source_unit_m(self) -> float | None:
        """Metres per unit of the files; None where the object's true size is not known."""
        return None if self.unit_m is None else self.unit_m * self.scale

    def facts(self) -> dict[str, Any]:
        """Plain values for a file's header."""
        return {"T_scene_source": self.T_scene_source.tolist(), "unit_m": self.unit_m}

    @classmethod
    def of_facts(cls, facts: Mapping[str, Any] | None) -> "SourceFrame | None":
        """Inverse of ``facts``; None for files from before it was known."""
        return None if facts is None else cls(np.asarray(facts["T_scene_source"], dtype=np.float64), facts["unit_m"])
