"""What tests ask of segments with each other: that none shares volume with another that is not declared nested."""

from mereo.geometry.mesh import SegmentedMesh
from mereo.geometry.mesh_check import TOLERANCE, overlaps


def check_overlap(mesh: SegmentedMesh, tolerance: float = TOLERANCE) -> None:
    """Fail naming every two segments that share more than ``tolerance`` of the smaller one.

    Segments that touch share no volume. A pair that ``mesh.nested`` declares may share any, but at most ``tolerance``
    of the inner segment may lie outside the outer one.
    """
    found = overlaps(mesh, tolerance)
    assert found == (), "; ".join(str(overlap) for overlap in found)
