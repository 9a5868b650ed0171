"""States of a soft liver from a finite-element simulation in MuJoCo, for training on simulated deformations.

    python examples/simulate_liver.py                                        # 3 states of a coarse liver, seconds
    python examples/simulate_liver.py --organs --frames 300 --output liver.npz   # what the scene liver-simulated uses

The coarse body is the one that LapGym simulates (98 nodes, two thirds of the organ's volume). With ``--organs`` it is a
lattice of tetrahedra around the scene `liver`'s two organs, which carries their fine surfaces; a state takes seconds.

Each state is the equilibrium under one to three instruments, which grasp tissue around random surface nodes and move it
by 10 to 35 mm in random directions, and a random share of gravity (the patient's position). The tissue hangs at its
back, where ligaments hold it. The file holds tetrahedral states (docs/scene-file.md), millimetres.

Material: Saint Venant-Kirchhoff, Young's modulus 5 kPa (a healthy liver's; Yeh et al., Ultrasound in Medicine & Biology
2002, measure 0.6 to 12 kPa in vitro), Poisson's ratio 0.4 (linear tetrahedra lock closer to 0.5), 1060 kg per cubic
metre. MuJoCo's `discrete` integrator is implicit in position, so that the equilibrium is reached in large steps.
"""

import argparse
import time
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from mereo.deformation.tetrahedral import Tetrahedra
from mereo.geometry.solids import Solids
from mereo.io.atomic_files import atomic_file, check_file_place
from mereo.io.vtk_frames import read_vtk_frames
from mereo.scenes.registry import load_scene
from mereo_objects import assets

YOUNG_PA, POISSON, DENSITY, GRAVITY = 5000.0, 0.4, 1060.0, 9.81
BACK = np.array([0.05, 0.6, 0.8])
HELD_MM = 40.0
"""Nodes within 40 mm of the one farthest along this direction are held: the bare area."""

TOOLS = (1, 3)
DEPTH_MM = (10.0, 35.0)
GRIP_MM = 15.0
GRIP_NEWTON_PER_M = 50.0
"""How many, how far, how wide (standard deviation), and each node's spring at the centre of the grip."""

GRAVITY_SHARE = 0.1
TIMESTEP_S, DAMPING_S, DRAG_PER_S = 0.01, 0.01, 10.0
"""They decide how fast the body comes to rest, not where: other values move the result by 0.1 mm at most."""

STILL_MM_PER_S, LONGEST_S = 0.5, 4.0
LEAST_MM, MOST_MM, LEAST_VOLUME = 5.0, 40.0, 0.3
"""A state is kept when its largest displacement and its most compressed tetrahedron are within these."""

CELL_MM = 16.0
MM_PER_UNIT = 162.68 / 20.0
"""The scene `liver`'s scale."""

Nodes = Float[np.ndarray, "n 3"]
Elements = Int[np.ndarray, "m 4"]


# --- tetrahedra -------------------------------------------------------------------------------------------------------


def coarse_body() -> tuple[Nodes, Elements]:
    """Nodes and tetrahedra of LapGym's liver, millimetres."""
    frames = read_vtk_frames([assets.get("liver/lapgym_liver_volumetric.vtk")])
    return frames.points[0], frames.tetrahedra


FIVE = np.array([[0, 4, 2, 1], [6, 4, 7, 2], [5, 4, 1, 7], [3, 2, 7, 1], [4, 2, 1, 7]])
"""A cube's corners (number 4x + 2y + z) as five tetrahedra; those of its neighbours are mirrored, so faces match."""


def lattice_around_organs() -> tuple[Nodes, Elements]:
    """Cubes of ``CELL_MM`` that liver or gallbladder touch, each as five tetrahedra; millimetres about the origin."""
    rest = load_scene("liver").rest
    vertices = np.concatenate([segment.vertices for segment in rest.segments]) * MM_PER_UNIT
    low, high = vertices.min(axis=0) - 1.0, vertices.max(axis=0) + 1.0
    count = np.ceil((high - low) / CELL_MM).astype(int)
    origin = (low + high - count * CELL_MM) / 2
    touched = np.zeros(count, dtype=bool)
    touched[tuple(np.floor((vertices - origin) / CELL_MM).astype(int).T)] = True
    cells = np.argwhere(np.ones_like(touched))
    samples = (np.argwhere(np.ones((4, 4, 4))) + 0.5) / 4
    inside = Solids(rest).label(((cells[:, None] + samples) * CELL_MM + origin).reshape(-1, 3) / MM_PER_UNIT) > 0
    touched |= inside.reshape(*count, -1).any(axis=-1)
    cells = np.argwhere(touched)
    corners = (cells[:, None] + np.argwhere(np.ones((2, 2, 2)))).reshape(-1, 3)
    number = np.ravel_multi_index(tuple(corners.T), tuple(count + 1)).reshape(-1, 8)
    odd = cells.sum(axis=1) % 2 == 1
    number[odd] = number[odd][:, [4, 5, 6, 7, 0, 1, 2, 3]]
    used, elements = np.unique(number[:, FIVE], return_inverse=True)
    nodes = np.stack(np.unravel_index(used, tuple(count + 1)), axis=1) * CELL_MM + origin
    return nodes, elements.reshape(-1, 4)


# --- simulation -------------------------------------------------------------------------------------------------------


class SoftBody:
    """A MuJoCo model of the body; all lengths given and returned are millimetres."""

    def __init__(self, mesh: Tetrahedra) -> None:
        import mujoco

        self.mujoco, self.mesh = mujoco, mesh
        along = mesh.nodes @ BACK
        held = np.linalg.norm(mesh.nodes - mesh.nodes[along.argmax()], axis=1) < HELD_MM
        self.model = mujoco.MjModel.from_xml_string(self._xml(held))
        self.data = mujoco.MjData(self.model)
        self.model.dof_damping[:] = DRAG_PER_S * self.model.body_mass[self.model.dof_bodyid]
        self.handles = np.setdiff1d(mesh.surface, np.flatnonzero(held))
        # a free node is a body with three sliding joints along x, y and z
        node_of_body = np.zeros(self.model.nbody, dtype=int)
        node_of_body[self.model.flex_vertbodyid[~held]] = np.flatnonzero(~held)
        self.joint_node = node_of_body[self.model.jnt_bodyid]
        self.joint_axis = np.abs(self.model.jnt_axis).argmax(axis=1)

    def _xml(self, held: np.ndarray) -> str:
        points = " ".join(f"{value:.9g}" for value in (self.mesh.nodes / 1000).ravel())
        elements = " ".join(map(str, self.mesh.elements.ravel()))
        pinned = " ".join(map(str, np.flatnonzero(held)))
        mass = np.abs(self.mesh.volumes).sum() * 1e-9 * DENSITY
        return f"""<mujoco><option timestep="{TIMESTEP_S}" integrator="discrete"><flag contact="disable"/></option>
            <size memory="200M"/><worldbody><flexcomp name="body" type="direct" dim="3" mass="{mass}" radius="1e-4"
            point="{points}" element="{elements}"><pin id="{pinned}"/><contact selfcollide="none"/>
            <elasticity young="{YOUNG_PA}" poisson="{POISSON}" damping="{DAMPING_S}"/>
            </flexcomp></worldbody></mujoco>"""

    def state(self, rng: np.random.Generator) -> Nodes:
        """Displacements of one random state, drawn again until it is within the bounds above."""
        for _ in range(50):
            self._grasp(rng)
            if not self._settle():
                continue
            moved = self.data.flexvert_xpos * 1000 - self.mesh.nodes
            moved = moved.astype(np.float16).astype(np.float64)  # as it will be stored
            largest = np.linalg.norm(moved, axis=1).max()
            if LEAST_MM <= largest <= MOST_MM and self.mesh.volume_ratios(self.mesh.nodes + moved).min() > LEAST_VOLUME:
                return moved
        raise RuntimeError("50 draws gave no state within the bounds; weaken the instruments")

    def _grasp(self, rng: np.random.Generator) -> None:
        """Springs from the nodes around each tool to where it takes them; implicit, unlike applied forces."""
        weight = np.zeros(len(self.mesh.nodes))
        target = np.zeros_like(self.mesh.nodes)
        for _ in range(rng.integers(TOOLS[0], TOOLS[1] + 1)):
            center = self.mesh.nodes[rng.choice(self.handles)]
            grip = np.exp(-0.5 * (np.linalg.norm(self.mesh.nodes - center, axis=1) / GRIP_MM) ** 2)
            weight += grip
            target += grip[:, None] * rng.uniform(*DEPTH_MM) * _direction(rng)
        target /= np.maximum(weight, 1e-9)[:, None]
        self.mujoco.mj_resetData(self.model, self.data)
        self.model.jnt_stiffness[:] = GRIP_NEWTON_PER_M * weight[self.joint_node]
        self.model.qpos_spring[:] = target[self.joint_node, self.joint_axis] / 1000
        self.model.opt.gravity[:] = rng.uniform(0, GRAVITY_SHARE) * GRAVITY * _direction(rng)

    def _settle(self) -> bool:
        """Step until nothing moves; False where that takes too long or MuJoCo warns."""
        while self.data.time < LONGEST_S:
            self.mujoco.mj_step(self.model, self.data, 20)
            if any(warning.number for warning in self.data.warning):
                return False
            if np.abs(self.data.qvel).max() * 1000 < STILL_MM_PER_S:
                return True
        return False


def _direction(rng: np.random.Generator) -> Float[np.ndarray, "3"]:
    vector = rng.normal(size=3)
    return vector / np.linalg.norm(vector)


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description="Record random states of a soft liver, simulated by MuJoCo.")
    parser.add_argument("--organs", action="store_true", help="liver and gallbladder in a fine lattice")
    parser.add_argument("--frames", type=int, default=3)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--output", type=Path, default=Path("liver_states.npz"), help="the NPZ to write")
    parser.add_argument("--force", action="store_true", help="replace the file where it exists")
    options = parser.parse_args(arguments)
    try:
        check_file_place(options.output, force=options.force)
    except (OSError, ValueError) as error:
        parser.error(str(error))
    try:
        mesh = Tetrahedra(*(lattice_around_organs() if options.organs else coarse_body()))
        body = SoftBody(mesh)
    except ImportError as error:
        raise SystemExit("MuJoCo or pyvista is missing: pip install 'mereo[simulation]'") from error
    start = time.monotonic()
    displacements = np.empty((options.frames, *mesh.nodes.shape), dtype=np.float16)
    for frame in range(options.frames):  # state i comes from (seed, i) alone
        displacements[frame] = body.state(np.random.default_rng([options.seed, frame]))
        largest = np.linalg.norm(displacements[frame].astype(np.float64), axis=1).max()
        each = (time.monotonic() - start) / (frame + 1)
        print(f"state {frame}: up to {largest:.1f} mm, {each:.2f} s each", flush=True)
    with atomic_file(options.output, force=options.force) as partial:
        np.savez_compressed(
            partial,
            rest_nodes=mesh.nodes.astype(np.float32),
            tetrahedra=mesh.elements.astype(np.int32),
            displacements=displacements,
        )
    print(f"wrote {options.output}: {options.frames} states of {len(mesh.nodes)} nodes")


if __name__ == "__main__":
    main()
