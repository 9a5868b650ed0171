"""``mereo scene modes``: how many modes of deformation the states of an object need, and what they look like."""

from pathlib import Path

from rich.console import Console
from rich.table import Table

from mereo.io.atomic_files import atomic_file, check_file_place
from mereo.io.extras import CURE, has_plots
from mereo.models.weights import load_model
from mereo.scenes.random_states import LEAST_STATES, scene_model
from mereo.scenes.registry import files_of, load_scene
from mereo.scenes.statistical_model import StatisticalModel
from mereo.visualization.mode_pictures import preview_modes

SHARES = (0.9, 0.95, 0.99, 0.999)
"""Shares of the variance for which the number of modes is told."""

ENOUGH = 0.1
"""Distance in scene units that modes may leave of a state: the noise of the paper's sensor."""


def show_modes(scene: str, output: Path | None, states: int, force: bool = False) -> None:
    """Print how many modes the states of an object need, and draw the largest; ``mereo scene modes``.

    Args:
        scene: name or file of a scene, or a file of weights that carry a statistical model.
        output: the picture; None draws none.
        states: random states from which a scene's model is built.
        force: replace an existing picture, unless it is read.

    Raises ``FileExistsError`` as ``atomic_file`` does; ``ValueError`` for too few states, for weights
    without a model and for another suffix than .png.
    """
    check_file_place(output, force=force)
    if output is not None and output.suffix.lower() != ".png":
        raise ValueError(f"{output} has the suffix {output.suffix!r}; the picture is a PNG file: rename it")
    name, model = _model_of(scene, states)
    console = Console(markup=False, emoji=False)
    console.print(_table(name, model))
    console.print(_needed(model), highlight=False, soft_wrap=True)
    if output is not None:
        with atomic_file(output, force=force, inputs=files_of(scene)) as partial:
            preview_modes(model, partial, name)
        console.print(f"wrote {output}", highlight=False, soft_wrap=True)
        if not has_plots():
            console.print(f"its plot is left out, for matplotlib {CURE}", highlight=False, soft_wrap=True)


def _model_of(scene: str, states: int) -> tuple[str, StatisticalModel]:
    if scene.endswith(".safetensors"):
        network = load_model(scene)
        if network.statistical_model is None:
            raise ValueError(f"{scene} carries no statistical model: name the scene that it was trained on instead")
        return str(network.provenance.get("scene")), network.statistical_model
    if states < LEAST_STATES:
        raise ValueError(f"{states} states are asked for; fewer than {LEAST_STATES} say little: leave --states out")
    loaded = load_scene(scene)
    return loaded.name, scene_model(loaded, states, quiet=False)


def _table(name: str, model: StatisticalModel) -> Table:
    table = Table(title=f"{name}: {model.count} modes of {len(model.library)} states", title_justify="left")
    for column in ("share of the variance", "modes", "left of an unseen state, rms"):
        table.add_column(column, justify="right")
    for share in SHARES:
        count = int((model.explained < share).sum()) + 1
        if count <= model.count:
            table.add_row(f"{share:.1%}", str(count), f"{model.residues[count]:.3f} units")
    table.add_row("all modes", str(model.count), f"{model.residue:.3f} units")
    return table


def _needed(model: StatisticalModel) -> str:
    count = model.modes_for(ENOUGH)
    if count is None:
        return (
            f"even all modes leave {model.residue:.3f} units, more than {ENOUGH}, the noise of the paper's sensor: the "
            "states lie on a curved set, so the scene's own draws fit better (--method full)"
        )
    return f"{count} modes leave at most {ENOUGH} units, the noise of the paper's sensor"
