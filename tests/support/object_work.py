"""A folder of objects to learn."""

from pathlib import Path

from scene_files import write_bar


def folder_of_objects(top: Path) -> Path:
    """Two objects: a subfolder of meshes, and a scene file."""
    (top / "objects/bar").mkdir(parents=True)
    write_bar(top / "objects/bar").unlink()
    (top / "meshes").mkdir()
    write_bar(top / "meshes")
    scene = (top / "meshes/bar.yaml").read_text().replace("file: ", "file: ../meshes/")
    (top / "objects/pole.yaml").write_text(scene.replace("name: bar", "name: pole"))
    (top / "objects/notes").mkdir()
    (top / "objects/notes/readme.txt").write_text("no object")
    return top / "objects"
