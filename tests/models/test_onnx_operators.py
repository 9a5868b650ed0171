"""The stand-ins for operators that ONNX lacks give what torch's own give."""

import pytest
import torch
import torch.nn.functional as F

from mereo.models.export.onnx_export import trilinear
from mereo.models.rigid_alignment import fit_rigid, svd3


def matrices(count: int) -> torch.Tensor:
    return torch.randn(count, 3, 3, generator=torch.Generator().manual_seed(0))


def special() -> torch.Tensor:
    """Equal singular values, rank two, a reflection, columns in no order of length, and values far apart."""
    flat = matrices(1)[0].clone()
    flat[:, 2] = flat[:, 0] + flat[:, 1]
    far = torch.diag(torch.tensor([1e-3, 1e3, 1.0])) @ torch.linalg.qr(matrices(1)[0]).Q
    return torch.stack([torch.eye(3), flat, torch.diag(torch.tensor([1.0, -2.0, 3.0])), far, 1e-6 * matrices(1)[0]])


@pytest.mark.parametrize("matrix", [matrices(200), special()], ids=["random", "special"])
def test_svd_has_orthogonal_factors_that_multiply_to_the_matrix(matrix: torch.Tensor) -> None:
    u, values, vh = svd3(matrix)
    identity = torch.eye(3).expand_as(matrix)
    torch.testing.assert_close(u.transpose(1, 2) @ u, identity, atol=1e-5, rtol=0)
    torch.testing.assert_close(vh @ vh.transpose(1, 2), identity, atol=1e-5, rtol=0)
    size = matrix.abs().amax(dim=(1, 2), keepdim=True)
    torch.testing.assert_close((u * values[:, None]) @ vh / size, matrix / size, atol=1e-5, rtol=0)
    torch.testing.assert_close(values / size[:, 0], torch.linalg.svdvals(matrix) / size[:, 0], atol=1e-5, rtol=0)


def test_rigid_fits_are_those_of_torchs_svd(monkeypatch: pytest.MonkeyPatch) -> None:
    generator = torch.Generator().manual_seed(1)
    source, target = torch.randn(50, 30, 3, generator=generator), torch.randn(50, 30, 3, generator=generator)
    expected = fit_rigid(source, target + 3 * source)
    monkeypatch.setattr(torch.linalg, "svd", svd3)
    found = fit_rigid(source, target + 3 * source)
    torch.testing.assert_close(found.rotation, expected.rotation, atol=2e-5, rtol=0)
    torch.testing.assert_close(found.shift, expected.shift, atol=2e-5, rtol=0)
    flat = source * torch.tensor([1.0, 1.0, 0.0])
    mirrored = fit_rigid(flat, flat * torch.tensor([1.0, -1.0, 1.0]))
    torch.testing.assert_close(torch.linalg.det(mirrored.rotation), torch.ones(50), atol=1e-5, rtol=0)


def test_sampling_is_torchs_also_on_nodes_and_beyond_the_border() -> None:
    generator = torch.Generator().manual_seed(2)
    volume = torch.randn(1, 3, 5, 6, 7, generator=generator)
    places = 3 * torch.rand(1, 4, 25, 2, 3, generator=generator) - 1.5
    places[0, 0, :3, 0] = torch.tensor([[1.0, 1.0, 1.0], [-1.0, -1.0, -1.0], [0.0, 1.0, -1.0]])
    expected = F.grid_sample(volume, places, padding_mode="border", align_corners=True)
    torch.testing.assert_close(trilinear(volume, places, 0, 1, True), expected, atol=1e-5, rtol=0)
