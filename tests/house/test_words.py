"""Sentences name options on the command line and arguments in Python."""

from pathlib import Path

import numpy as np
import pytest
from toy_frames import MODEL, seen

import mereo
from mereo.__main__ import main
from mereo.api.words import SPEAKS_OPTIONS, in_python, option_words, python_words

OUT = "choose another --output or pass --force"


@pytest.mark.parametrize(
    ("told", "meant"),
    [
        (OUT, "choose another output or pass overwrite=True"),
        ("leave them out with --drop-invalid", "leave them out with drop_invalid=True"),
        ("(--keep-all keeps them)", "(isolation=IsolationConfig(keep_all=True) keeps them)"),
        ("(--unit-m 0.001 for clouds in millimetres)", "(unit_m=0.001 for clouds in millimetres)"),
        ("correct the unit (--unit-m, --depth-scale)", "correct the unit (unit_m, depth_scale)"),
        ("turn the cloud (--frame), or name", "turn the cloud (axes), or name"),
        ("needed: give --intrinsics FILE", "needed: give intrinsics=file"),
        ("give --depth-scale 1000 for millimetres", "give depth_scale=1000 for millimetres"),
        ("or use --method modes", 'or use method="modes"'),
        ("ask again with --method network.", 'ask again with method="network".'),
        (
            "crop with --box or --depth-range",
            "crop with isolation=IsolationConfig(box=...) or isolation=IsolationConfig(depth_range=...)",
        ),
        ("name one with --topic", "name one with topic"),
        ("choose one with --frame-index 0", "choose one with frame_index=0"),
        ("two - or three -- of them, well-known", "two - or three -- of them, well-known"),
        ("", ""),
    ],
)
def test_options_are_arguments_in_python(told: str, meant: str) -> None:
    assert in_python(told) == meant
    assert in_python(meant) == meant, "said once"


def test_an_error_is_told_in_the_words_of_who_asks() -> None:
    with pytest.raises(FileExistsError) as caught, python_words():
        raise FileExistsError(OUT)
    assert str(caught.value) == in_python(OUT)
    with option_words(), pytest.raises(FileExistsError) as caught, python_words():
        raise FileExistsError(OUT)
    assert str(caught.value) == OUT and not SPEAKS_OPTIONS.get()
    with pytest.raises(KeyError, match="--force"), python_words():
        raise KeyError("--force")
    with pytest.raises(OSError) as system, python_words():
        raise OSError(2, "--force")
    assert system.value.errno == 2 and system.value.strerror == "--force"


def test_one_frame_is_refused_in_two_languages(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The command's words are options, also after somebody has asked in Python."""
    cloud = seen()
    cloud[3] = np.nan
    np.save(tmp_path / "cloud.npy", cloud)
    with pytest.raises(ValueError, match="drop_invalid=True") as caught:
        mereo.reconstruct(tmp_path / "cloud.npy", MODEL)
    assert "--" not in str(caught.value)
    arguments = ["reconstruct", str(tmp_path / "cloud.npy"), "--weights", "rope", "--output", str(tmp_path / "out")]
    assert main(arguments) == 2 and "--drop-invalid" in capsys.readouterr().err
    assert not SPEAKS_OPTIONS.get()
    with pytest.raises(ValueError, match="drop_invalid=True"):
        mereo.load_frame(tmp_path / "cloud.npy")


def test_a_folder_that_is_there_is_refused_in_python(tmp_path: Path) -> None:
    result = mereo.reconstruct(seen(), MODEL, "network", resolution=8)
    (tmp_path / "out").mkdir()
    (tmp_path / "out/mine.txt").write_text("keep")
    with pytest.raises(FileExistsError, match="overwrite=True") as caught:
        result.save(tmp_path / "out")
    assert "--" not in str(caught.value)
