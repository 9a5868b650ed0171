"""The segments that a scene file names, in its own unit and frame: mesh files, parts of a model, or a label volume."""

from collections.abc import Sequence
from pathlib import Path

from manifold3d import Manifold, OpType

from mereo.geometry.manifold import mesh_of, solid_of
from mereo.geometry.mesh import PALETTE, Segment, SegmentedMesh
from mereo.io.mesh_formats import read_segmented_mesh
from mereo.io.yaml_document import Document, similar
from mereo.scenes.files.schema import FilePart, ModelPart, PartLook, SceneFile


def read_segments(document: Document, file: SceneFile) -> SegmentedMesh:
    """Segments of a scene file as they are in its meshes, unchecked and unscaled.

    Raises ``ValueError`` and ``FileNotFoundError`` with the line that names what cannot be had, ``ImportError`` naming
    the extra that a format needs.
    """
    folder = document.path.parent
    if file.segments is not None:
        return _assembled(document, "segments", file.segments, _from_files(document, file.segments))
    if file.model is not None:
        model = _read(document, ("model",), folder / file.model)
        if file.parts is None:
            return model
        return _assembled(document, "parts", file.parts, _from_model(document, file.parts, model))
    from mereo.io.label_volumes import read_label_volume, segment_surfaces

    assert file.labels is not None and file.names is not None, "the schema asks for both"
    with document.named_at(("labels",)):
        return segment_surfaces(read_label_volume(folder / file.labels), file.names, file.cells)


def _read(document: Document, place: Sequence[int | str], path: Path) -> SegmentedMesh:
    """A mesh file; errors say which line names it."""
    with document.named_at(place):
        return read_segmented_mesh(path)


def _from_files(document: Document, parts: Sequence[FilePart]) -> list[Segment]:
    folder = document.path.parent
    return [
        _joined(part, _read(document, ("segments", index, "file"), folder / part.file).segments)
        for index, part in enumerate(parts)
    ]


def _from_model(document: Document, parts: Sequence[ModelPart], model: SegmentedMesh) -> list[Segment]:
    segments = []
    for index, part in enumerate(parts):
        wanted = part.parts or [part.name]
        if missing := [name for name in wanted if name not in model.names]:
            raise document.error(
                ("parts", index), f"the model has no part {missing[0]!r}: {similar(missing[0], list(model.names))}"
            )
        segments.append(_joined(part, [model.segments[model.names.index(name)] for name in wanted]))
    return segments


def _joined(part: PartLook, pieces: Sequence[Segment]) -> Segment:
    """One segment of all pieces: their union where each is a solid, else all of their faces."""
    if len(pieces) == 1:
        return Segment(part.name, pieces[0].color, pieces[0].vertices, pieces[0].faces)
    try:
        solids = [solid_of(piece.vertices, piece.faces) for piece in pieces]
        vertices, faces = mesh_of(Manifold.batch_boolean(solids, OpType.Add))
    except ValueError:
        vertices, faces, _ = SegmentedMesh(tuple(pieces)).merged()
    return Segment(part.name, pieces[0].color, vertices, faces)


def _assembled(document: Document, key: str, parts: Sequence[PartLook], segments: Sequence[Segment]) -> SegmentedMesh:
    """The segments with the file's colours and nesting."""
    names = [part.name for part in parts]
    for index, part in enumerate(parts):
        if part.nested_in is not None and part.nested_in not in names:
            raise document.error(
                (key, index, "nested_in"), f"no segment is called {part.nested_in!r}: {similar(part.nested_in, names)}"
            )
    nested = tuple((part.name, part.nested_in) for part in parts if part.nested_in is not None)
    try:
        return SegmentedMesh(tuple(_colored(segments, parts)), nested)
    except ValueError as error:
        raise document.error((key,), str(error)) from None


def _colored(segments: Sequence[Segment], parts: Sequence[PartLook]) -> list[Segment]:
    """The file's colours; without one the mesh's own, where they tell the segments apart, or the palette's."""
    own = [segment.color for segment in segments]
    fallback = own if len(set(own)) == len(own) else [PALETTE[i % len(PALETTE)] for i in range(len(own))]
    return [
        Segment(segment.name, part.color or color, segment.vertices, segment.faces)
        for segment, part, color in zip(segments, parts, fallback, strict=True)
    ]
