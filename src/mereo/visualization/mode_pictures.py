"""Pictures of an object's modes of deformation, and of how many of them its states need."""

import io
from pathlib import Path

import numpy as np
from PIL import Image

from mereo.geometry.mesh import SegmentedMesh
from mereo.io.extras import has_plots, pyplot
from mereo.scenes.statistical_model import StatisticalModel
from mereo.visualization.contact_sheets import Picture, contact_sheet, save_png
from mereo.visualization.previews import SCENE_VIEWS, common_viewpoint
from mereo.visualization.renderer import shade

SHOWN_STD = (-2.0, 0.0, 2.0)
"""Coefficients, in standard deviations, at which a mode is drawn."""

OBLIQUE = ((0.3, -0.4, -1.0), (0.0, 1.0, 0.0))
"""Viewing direction and up for objects that have none of their own."""


def preview_modes(model: StatisticalModel, path: str | Path, name: str = "", modes: int = 6, size: int = 200) -> None:
    """Write a sheet of the largest modes, each at -2, 0 and +2 standard deviations.

    Below them the residue by their number, where the extra `plots` is installed.

    Args:
        model: the statistical model.
        path: the .png file.
        name: of the object; a built-in scene's is drawn from its own side.
        modes: how many are drawn at most.
        size: width of each picture in pixels.
    """
    shown = min(modes, model.count)
    states = [[_at(model, mode, std) for std in SHOWN_STD] for mode in range(shown)] or [[_at(model, 0, 0.0)]]
    viewpoint = common_viewpoint([mesh for row in states for mesh in row], *SCENE_VIEWS.get(name, OBLIQUE))
    images = [shade(mesh, viewpoint, (size, size)) for row in states for mesh in row]
    captions = [_caption(model, mode, std) for mode in range(shown) for std in SHOWN_STD] or ["does not deform"]
    title = f"{name}: {model.count} modes leave {model.residue:.3f} units of an unseen state"
    sheet = contact_sheet(images, captions, 2 * len(SHOWN_STD) if shown > 1 else len(images), title)
    plotted = model.count and has_plots()
    save_png(path, np.concatenate([sheet, _residue_plot(model, sheet.shape[1])]) if plotted else sheet)


def _at(model: StatisticalModel, mode: int, std: float) -> SegmentedMesh:
    z = np.zeros(model.count)
    if model.count:
        z[mode] = std
    return model.mesh(model.material(z))


def _caption(model: StatisticalModel, mode: int, std: float) -> str:
    if std == 0.0:
        return "mean state"
    share = float(model.motion[mode] ** 2 / (np.sum(model.motion**2) + model.residue**2))
    return f"mode {mode + 1} at {std:+.0f} std, {share:.1%} of the variance"


def _residue_plot(model: StatisticalModel, width: int, height: int = 260) -> Picture:
    """Distance that is left of a state against the number of modes, as wide as the sheet above it."""
    plt = pyplot()
    figure, axes = plt.subplots(figsize=(width / 100, height / 100), dpi=100, layout="constrained")
    axes.semilogy(np.arange(model.count + 1), model.residues, color="#2563c9")
    axes.axhline(model.residue, color="#98a2b3", linestyle=":")
    axes.set(xlabel="modes", ylabel="left of a state, rms (units)", xlim=(0, model.count))
    axes.grid(alpha=0.3)
    content = io.BytesIO()
    figure.savefig(content, format="png")
    plt.close(figure)
    return np.asarray(Image.open(content).convert("RGB").resize((width, height)))
