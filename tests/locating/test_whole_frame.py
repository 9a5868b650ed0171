"""An object among other things, in a whole depth image: where it is, and that it is not there."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from angle import write_angle
from folder_contents import read_json
from numpy import ndarray
from numpy.linalg import norm
from numpy.random import default_rng
from numpy.testing import assert_allclose
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

import mereo
from mereo.__main__ import main
from mereo.fitting.registration.register import Registrar
from mereo.fitting.tracking import SynchronousExecutor
from mereo.fitting.uncertainty import radius95
from mereo.geometry.camera import Camera, DepthImage, SharedNoise
from mereo.geometry.mesh import Segment, SegmentedMesh
from mereo.geometry.transforms import rigid, transform_points
from mereo.locating.outline import Jumps, Outline, compare_outline
from mereo.locating.regions import connected_pixels, off_planes, regions, thinned
from mereo.locating.whole_frame import CHANCE, Place, WholeFrame, at_point, is_whole, judged
from mereo.reconstruction.observation import find_object, shared_noise, shared_side
from mereo.synthesis.depth_sensor import add_depth_noise, render_depth

CAMERA = Camera(240, 180, 260.0, 260.0, 120.0, 90.0)
NOISE = 2e-4
"""Metres."""

SLOPE = Rotation.from_euler("x", 35, degrees=True)
"""From a desk with y down into the camera frame."""


def on_desk(x: float, height: float, away: float) -> ndarray:
    """Place above the desk, metres."""
    return SLOPE.apply([x, -height, away]) + np.array([0.0, 0.05, 0.6])


PLACED = rigid((SLOPE * Rotation.from_euler("xyz", [70, 20, 100], degrees=True)).as_matrix(), on_desk(-0.02, 0.06, 0.0))
"""Pose of the angle, about its middle: a corner touches the desk."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("angle")
    write_angle(made)
    return made


@pytest.fixture(scope="module")
def angle(folder: Path) -> mereo.Object:
    meshes = [str(folder / "long.stl"), str(folder / "short.stl")]
    return mereo.load_object(meshes, units="mm", deformations="rigid")


@pytest.fixture(scope="module")
def registrar(angle: mereo.Object) -> Registrar:
    made = angle.registrar("auto")
    assert made is not None
    return made


@pytest.fixture(scope="module")
def rest(folder: Path) -> SegmentedMesh:
    """The angle about its middle, metres."""
    meshes = {name: trimesh.load(folder / f"{name}.stl") for name in ("long", "short")}
    middle = np.concatenate([mesh.vertices for mesh in meshes.values()]).mean(axis=0)
    return SegmentedMesh(tuple(segment(name, mesh, (mesh.vertices - middle) / 1000) for name, mesh in meshes.items()))


@pytest.fixture(scope="module")
def long(folder: Path) -> ndarray:
    """Places of one part of the angle in its files' frame, metres."""
    return np.asarray(trimesh.load(folder / "long.stl").vertices) / 1000


def segment(name: str, mesh: trimesh.Trimesh, vertices: ndarray) -> Segment:
    return Segment(name, (0, 0, 0), vertices, np.asarray(mesh.faces))


def things() -> list[Segment]:
    """A table, a wall behind it, and a ball, a can and a box on the table; metres."""
    table = trimesh.creation.box((3.0, 0.02, 3.0))
    table.apply_transform(rigid(SLOPE.as_matrix(), on_desk(0.0, -0.01, 0.0)))
    wall = trimesh.creation.box((6.0, 6.0, 0.02))
    wall.apply_translation([0.0, 0.0, 1.6])
    ball = trimesh.creation.icosphere(3, 0.03)
    can = trimesh.creation.cylinder(0.025, 0.1)
    box = trimesh.creation.box((0.08, 0.05, 0.06))
    for thing, place in ((ball, (0.12, 0.03, 0.0)), (can, (-0.16, 0.025, 0.08)), (box, (0.05, 0.025, 0.2))):
        thing.apply_transform(rigid(SLOPE.as_matrix(), on_desk(*place)))
    every = {"table": table, "wall": wall, "ball": ball, "can": can, "box": box}
    return [segment(name, mesh, np.asarray(mesh.vertices)) for name, mesh in every.items()]


def desk(*parts: Segment) -> DepthImage:
    """Depth image of the desk, and of what else is there."""
    return add_depth_noise(render_depth(SegmentedMesh((*things(), *parts)), CAMERA), NOISE, default_rng(0))


@pytest.fixture(scope="module")
def placed(rest: SegmentedMesh) -> SegmentedMesh:
    return rest.transformed(PLACED)


@pytest.fixture(scope="module")
def image(placed: SegmentedMesh) -> DepthImage:
    return desk(*placed.segments)


@pytest.fixture(scope="module")
def found(image: DepthImage, angle: mereo.Object) -> mereo.Result:
    return mereo.reconstruct(image, angle, unit_m=1.0)


def test_an_object_among_others_is_known_at_its_place(
    found: mereo.Result, image: DepthImage, rest: SegmentedMesh, long: ndarray
) -> None:
    assert found.known is True and found.pose is not None
    assert found.seen.steps[-1].name == "whole frame" and found.seen.steps[-1].before == image.valid.sum()
    true = transform_points(PLACED, rest.segments[0].vertices)
    assert_allclose(transform_points(found.pose, long), true, atol=2e-3)
    assert found.seen.cloud.points[:, 2].max() < 0.65, "neither the desk behind it nor the wall is taken for it"
    assert found.reconstruction.timings_s["fit"] == found.seconds, "with the looking, not of the last fit alone"


def test_the_covariance_of_a_rigid_objects_pose_is_that_of_its_points(found: mereo.Result) -> None:
    registered = found.registered
    covariance = found.covariance
    assert registered is not None and registered.uncertainty is not None and covariance is not None
    arms = registered.material - registered.pose()[:3, 3]
    turns = np.cross(np.eye(3), arms[:, None]).swapaxes(1, 2)  # by a turn about each axis
    follow = np.concatenate([turns, np.broadcast_to(np.eye(3), turns.shape)], axis=2)
    radii = radius95(follow @ covariance @ follow.swapaxes(1, 2))
    assert_allclose(radii, registered.uncertainty.material, rtol=0.02)


def test_what_is_not_in_the_frame_is_not_known_and_the_likeliest_place_is_stated(angle: mereo.Object) -> None:
    found = mereo.reconstruct(desk(), angle, unit_m=1.0)
    assert found.known is False
    assert "the object is not in this frame; what is most like it, at " in str(found.recognition.reason)


SECOND = rigid(
    (SLOPE * Rotation.from_euler("xyz", [20, 60, 10], degrees=True)).as_matrix(), on_desk(-0.15, 0.06, -0.08)
)


def test_each_instance_is_at_its_place_and_has_a_folder(
    placed: SegmentedMesh, rest: SegmentedMesh, angle: mereo.Object, long: ndarray, tmp_path: Path
) -> None:
    both = desk(*placed.segments, *(replace(each, name=f"{each.name} 2") for each in rest.transformed(SECOND).segments))
    found = mereo.reconstruct(both, angle, unit_m=1.0, instances="all")
    assert [each.known for each in found.instances] == [True, True] and found.instances[0] is found
    places = [transform_points(each.pose, long) for each in found.instances if each.pose is not None]
    for T in (PLACED, SECOND):
        true = transform_points(T, rest.segments[0].vertices)
        assert min(np.abs(place - true).max() for place in places) < 3e-3
    found.save(tmp_path / "result")
    summary = read_json(tmp_path / "result" / "summary.json")
    (further,) = summary["further_instances"]
    alone = read_json(tmp_path / "result" / "instance2" / "summary.json")
    assert further["pose"] == alone["pose"] != summary["pose"]
    every = trimesh.load_scene(tmp_path / "result" / "instances.glb")
    assert set(every.geometry) == {"1 long", "1 short", "2 long", "2 short"}


def test_several_instances_are_of_a_whole_frame(placed: SegmentedMesh, angle: mereo.Object) -> None:
    for count, message in ((2, ", which a whole depth image alone"), (0, "; it must be a whole number, at least 1")):
        with pytest.raises(ValueError, match=f"instances is {count}{message}"):
            mereo.reconstruct(render_depth(placed, CAMERA), angle, unit_m=1.0, instances=count)


def test_the_command_looks_through_the_frame_and_says_so(
    image: DepthImage, on_angle: tuple[int, int], folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    np.save(tmp_path / "depth.npy", image.depth)
    intrinsics = {"width": 240, "height": 180, "fx": 260.0, "fy": 260.0, "cx": 119.5, "cy": 89.5}
    (tmp_path / "camera.json").write_text(json.dumps(intrinsics), encoding="utf-8")
    given = [str(tmp_path / "depth.npy"), "--intrinsics", str(tmp_path / "camera.json"), "--object"]
    meshes = [str(folder / "long.stl"), str(folder / "short.stl"), "--units", "mm", "--deformations", "rigid"]
    point = ["--point", *map(str, on_angle), "--instances", "all", "--output", str(tmp_path / "result")]
    main(["reconstruct", *given, *meshes, *point])
    printed = capsys.readouterr().out
    where = "at the point {} {}".format(*on_angle)
    assert f"the object is looked for in all {image.valid.sum()} points of the frame, {where}" in printed
    assert "whole frame: " in printed and "where the object is likeliest" in printed
    summary = read_json(tmp_path / "result" / "summary.json")
    assert summary["isolation"][-1]["name"] == "whole frame" and summary["recognition"]["known"] is True


def test_a_mask_or_an_object_alone_is_not_looked_through(
    image: DepthImage, placed: SegmentedMesh, registrar: Registrar
) -> None:
    whole = find_object(mereo.load_frame(image, unit_m=1.0))
    assert is_whole(whole, registrar)
    alone = find_object(mereo.load_frame(render_depth(placed, CAMERA), unit_m=1.0))
    assert not is_whole(alone, registrar)
    masked = replace(whole, cloud=whole.cloud.rows(np.arange(len(whole.cloud)) < 500))
    assert not is_whole(masked, registrar)
    assert not is_whole(replace(whole, initial_pose=np.eye(4)), registrar)
    assert not is_whole(find_object(mereo.load_frame(image)), registrar), "of no known unit"


def test_a_frame_of_one_plane_holds_nothing_and_that_is_a_sentence(angle: mereo.Object) -> None:
    wall = DepthImage(np.full((180, 240), 1.0), CAMERA)
    with pytest.raises(ValueError, match="nothing in this frame is of the object's size and shape: check both"):
        mereo.reconstruct(wall, angle, unit_m=1.0)


def test_an_outline_that_is_not_the_images_makes_an_answer_unsure_or_refuses_it(found: mereo.Result) -> None:
    assert judged(found, None) is found, "nothing is around it"
    assert judged(found, Outline(100, shown=999)) is found
    few, wrong = (judged(found, Outline(*each, shown=999)).recognition for each in ((40,), (20, 0, 40)))
    assert few.known == "unsure" and wrong.known is False
    assert "20 of 60 pixels of it have an edge" in str(wrong.reason)
    assert judged(found, Outline(hits=40, shown=999), -CHANCE) is found, "a mask says where it is"


# --- where it is ------------------------------------------------------------------------------------------------------


def pixel_of(place: ndarray) -> tuple[int, int]:
    column, row = np.floor(CAMERA.project(place[None])[0]).astype(int)
    return int(column), int(row)


CAN = pixel_of(on_desk(-0.16, 0.04, 0.05))
BOX = (-0.11, -0.2, 0.4, 0.1, 0.2, 0.75)
"""Metres: the angle and the desk around it, without the ball, the can and the wall."""


@pytest.fixture(scope="module")
def on_angle(placed: SegmentedMesh) -> tuple[int, int]:
    """Pixel in the middle of the angle."""
    rows, columns = np.nonzero(render_depth(placed, CAMERA).valid)
    middle = np.hypot(rows - rows.mean(), columns - columns.mean()).argmin()
    return int(columns[middle]), int(rows[middle])


def looked_at(
    image: DepthImage,
    placed: SegmentedMesh,
    registrar: Registrar,
    config: mereo.IsolationConfig,
    outline: Outline = Outline(),  # noqa: B008 (immutable)
) -> list[ndarray]:
    """Regions that are looked at for the first place, were its outline this one."""
    looked = list[ndarray]()

    def look(frame: WholeFrame, mask: ndarray) -> Place:
        looked.append(mask)
        return Place(mask, (), placed, outline)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(WholeFrame, "look", look)
        seen = find_object(mereo.load_frame(image, unit_m=1.0), config)
        assert is_whole(seen, registrar)
        assert next(WholeFrame.of(seen, registrar).places()).mask is looked[0]
    return looked


def test_only_what_is_seen_at_a_point_is_looked_at(
    image: DepthImage, placed: SegmentedMesh, registrar: Registrar, on_angle: tuple[int, int]
) -> None:
    every = looked_at(image, placed, registrar, mereo.IsolationConfig())
    column, row = on_angle
    at_it = looked_at(image, placed, registrar, mereo.IsolationConfig(point=on_angle))
    assert 0 < len(at_it) < len(every) and all(mask[row - 2 : row + 3, column].any() for mask in at_it)
    (can,) = looked_at(image, placed, registrar, mereo.IsolationConfig(point=CAN))
    assert can[CAN[1], CAN[0]] and not can[row, column]
    evident = looked_at(image, placed, registrar, mereo.IsolationConfig(), Outline(hits=200, shown=999))
    assert len(evident) == 1, "the next region is looked at where that is not the object"


def test_a_box_is_looked_through_where_it_shows_more_than_the_object(
    image: DepthImage, placed: SegmentedMesh, registrar: Registrar
) -> None:
    frame = mereo.load_frame(image, unit_m=1.0)
    tight = mereo.IsolationConfig(box=(*placed.bounds.ravel(),))
    for config in (tight, mereo.IsolationConfig(box=BOX, remove_plane=True)):
        assert not is_whole(find_object(frame, config), registrar)
    places = CAMERA.directions() * image.depth[..., None]
    for mask in (masks := looked_at(image, placed, registrar, mereo.IsolationConfig(box=BOX))):
        assert (places[mask] >= BOX[:3]).all() and (places[mask] <= BOX[3:]).all()
    assert masks
    with pytest.raises(ValueError, match=f"the point {CAN[0]} {CAN[1]} lies outside .* or more than 5 pixels from any"):
        at_point(find_object(frame, mereo.IsolationConfig(box=BOX, point=CAN)), registrar)


@pytest.mark.slow
def test_a_point_or_a_box_has_the_answer_of_the_whole_frame_and_another_point_none(
    found: mereo.Result, image: DepthImage, angle: mereo.Object, on_angle: tuple[int, int]
) -> None:
    frame = mereo.load_frame(image, unit_m=1.0)
    narrowed = mereo.reconstruct(frame, angle, point=on_angle, box=BOX)
    assert narrowed.known is True and [step.name for step in narrowed.seen.steps] == ["box", "whole frame"]
    assert_allclose(narrowed.pose, found.pose, atol=2e-3)
    wrong = mereo.reconstruct(frame, angle, point=CAN).recognition
    assert wrong.known is False and f"the object is not at the point {CAN[0]} {CAN[1]}; " in str(wrong.reason)


def test_without_a_known_size_a_point_keeps_the_connected_surface(image: DepthImage) -> None:
    frame = mereo.load_frame(image)
    seen = find_object(frame, mereo.IsolationConfig(remove_plane=True, depth_range=(0.3, 1.2), point=CAN))
    kept = at_point(seen, None)
    assert [step.name for step in kept.steps] == ["depth range", "plane", "point"] and at_point(kept, None) is kept
    assert norm(kept.cloud.points - on_desk(-0.16, 0.025, 0.08), axis=1).max() < 0.08 < seen.size_m[0]


@pytest.mark.parametrize(
    ("point", "message"),
    [
        ((400, 20), "the point 400 20 lies outside the 240 x 180 pixels of"),
        ((3, 3), r"more than 5 pixels from any that is measured and kept \(the nearest is "),
        ((-1, 3), r"the point is \(-1, 3\); it must be the column and the row .* give for example point=\(320, 240\)"),
        ((np.nan, 2.0), "it must be the column and the row"),
    ],
)
def test_a_point_that_shows_nothing_is_refused(point: tuple[float, ...], message: str, angle: mereo.Object) -> None:
    image = DepthImage(np.pad(np.full((150, 210), 0.8), 15), CAMERA)
    with pytest.raises(ValueError, match=message):
        mereo.reconstruct(image, angle, unit_m=1.0, point=point)
    with pytest.raises(ValueError, match="has no pixels with a depth, of which a point is: crop with box"):
        mereo.reconstruct(image.to_points(), angle, point=(20, 20))


# --- regions ----------------------------------------------------------------------------------------------------------


def test_each_thing_is_a_region_and_no_plane_is(image: DepthImage, placed: SegmentedMesh) -> None:
    depth = render_depth(placed, CAMERA).depth
    shown = (depth > 0) & (np.abs(depth - image.depth) < 2e-3)
    off = off_planes(image, 0.12)
    assert off[shown].mean() > 0.95 and off.mean() < 0.2
    masks = regions(image, 0.12, 4e-3)
    overlap = [(mask & shown).sum() / (mask | shown).sum() for mask in masks]
    assert 3 <= len(masks) <= 8 and max(overlap) > 0.9


def test_faces_in_one_plane_and_what_hides_a_part_of_itself_are_regions() -> None:
    depth = np.ones((60, 80))
    depth[20:36, 8:24] = depth[20:36, 56:72] = 0.8  # as high above the table
    depth[28:36, 8:24] = 0.6
    depth[40::3] = depth[40:, ::3] = 0.0  # not measured, but no end of the table
    image = DepthImage(depth, Camera(80, 60, 80.0, 80.0, 40.0, 30.0))
    things = np.isin(depth, (0.6, 0.8))
    assert (off_planes(image, 0.4) == things).all()
    masks = regions(image, 0.4, 0.02)
    for part in (things & (np.arange(80) < 40), depth == 0.6):
        assert (masks == part).all(axis=(1, 2)).any()
    seen = find_object(mereo.load_frame(image), mereo.IsolationConfig(point=(12, 30)))
    assert len(at_point(seen, None).cloud) == 128, "the nearer half alone"


def test_surfaces_end_at_gaps_in_depth() -> None:
    depth = np.ones((4, 6))
    depth[:, 3:] = 1.5
    depth[0] = 0.0
    label = connected_pixels(depth, 0.1)
    assert len(np.unique(label[1:, :3])) == len(np.unique(label[1:, 3:])) == 1
    assert len(np.unique(label)) == 2 + 6, "a pixel that is not measured is alone"


def test_a_large_image_is_thinned_to_pixels_that_are_its_own() -> None:
    camera = Camera(900, 700, 1000.0, 1100.0, 440.0, 360.0)
    depth = default_rng(0).uniform(0.9, 1.1, (700, 900))
    thin, every = thinned(DepthImage(depth, camera), 0.3)
    assert every == 5 and thin.depth.shape == (140, 180)
    points = depth[2::5, 2::5, None] * camera.directions()[2::5, 2::5]
    places = thin.camera.directions()
    assert_allclose(thin.depth[..., None] * places, points, atol=1e-12)
    assert thinned(DepthImage(depth, camera), 0.05)[1] == 1


# --- outlines ---------------------------------------------------------------------------------------------------------


def test_the_true_pose_has_its_outline_and_others_have_not(image: DepthImage, placed: SegmentedMesh) -> None:
    jumps = Jumps.of(image, 0.12)

    def outline_at(shift: list[float]) -> tuple[float, float]:
        moved = placed.transformed(rigid(np.eye(3), np.array(shift)))
        outline = compare_outline(jumps, render_depth(moved, CAMERA).depth)
        return outline.nats, outline.misses / max(outline.hits + outline.misses, 1)

    nats, missed = outline_at([0.0, 0.0, 0.0])
    assert nats > 3 and missed < 0.05
    shifted = [outline_at(shift)[0] for shift in ([0.03, 0, 0], [0, 0.03, 0.02], [0.12, 0.02, 0.0], [0, -0.05, -0.1])]
    assert max(shifted) < 0, "elsewhere, in front of other things, and on other things"
    assert compare_outline(jumps, np.zeros((180, 240))).nats == -np.inf, "it is nowhere in the picture"


def test_what_an_occluder_hides_of_the_outline_does_not_count(image: DepthImage, placed: SegmentedMesh) -> None:
    depth = render_depth(placed, CAMERA).depth
    columns = np.flatnonzero((depth > 0).any(axis=0))
    hidden = image.depth.copy()
    hidden[:, : int(np.median(columns))] = 0.25
    outline, whole = (
        compare_outline(Jumps.of(DepthImage(each, CAMERA), 0.12), depth) for each in (hidden, image.depth)
    )
    assert outline.hits < 0.7 * whole.hits and outline.misses <= whole.misses and outline.hidden > 0.2 * outline.shown


@pytest.mark.parametrize("level", [0.0, 1e-3, 4e-3])
@pytest.mark.parametrize("std", [0.0, 1e-3, 4e-3])
def test_noise_that_neighbours_share_is_measured_on_the_plane_around_the_object(
    placed: SegmentedMesh, std: float, level: float
) -> None:
    clean = desk(*placed.segments)
    depth = render_depth(placed, CAMERA).depth
    rng = default_rng(1)
    field = gaussian_filter(rng.normal(size=depth.shape), 8)
    shared = np.where(clean.valid, clean.depth + level * clean.depth * field / field.std(), 0.0)
    noisy = add_depth_noise(DepthImage(shared, clean.camera), std, rng)
    shown = depth > 0
    distance = np.median(depth[shown])
    # of single pixels' noise half may pass for shared, as things on the plane widen what is left over
    noise = shared_noise(noisy, shown)
    assert noise.pixel == 1 / CAMERA.focal_x_px
    assert noise.std == pytest.approx(level * distance, rel=0.3, abs=2e-3 * distance + 0.6 * std)
    if level > std:  # else what is left over is none of the field
        assert noise.side * CAMERA.focal_x_px == pytest.approx(np.sqrt(np.pi) * 16, rel=0.3)
    assert shared_noise(noisy, np.ones_like(shown)) == SharedNoise()  # nothing is around it
    assert shared_side(np.ones((40, 60))) > 30 and shared_side(rng.normal(size=(200, 300))) < 20


# --- sequences --------------------------------------------------------------------------------------------------------


def test_an_object_is_followed_through_whole_frames_lost_and_seen_again(
    image: DepthImage, rest: SegmentedMesh, long: ndarray, angle: mereo.Object, on_angle: tuple[int, int]
) -> None:
    """Its point is where it is in the first frame."""
    with mereo.Tracker(angle, executor=SynchronousExecutor()) as tracker:
        for number in range(4):
            turn = Rotation.from_euler("y", 2 * number, degrees=True).as_matrix()
            moved = PLACED @ rigid(turn, np.array([0.003 * number, 0.0, 0.0]))
            seen = desk(*rest.transformed(moved).segments)
            found = tracker.follow(seen, number / 15, unit_m=1.0, point=on_angle)
            assert found.tracking == ("followed" if number else "found") and found.pose is not None
            off = transform_points(found.pose, long) - transform_points(moved, rest.segments[0].vertices)
            assert norm(off, axis=1).max() < 0.006, "a pixel is 2.2 mm wide"
        assert tracker.follow(desk(), 5 / 15, unit_m=1.0, point=(0, 9999)).tracking == "lost"
        assert tracker.follow(image, 20 / 15, unit_m=1.0, point=CAN).tracking == "found"
        tracker.forget()
        assert tracker.follow(desk(), 0.0, unit_m=1.0).tracking == "lost", "the likeliest place has another outline"
