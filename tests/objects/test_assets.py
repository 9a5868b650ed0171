"""The registry: where a file comes from, what is checked, and what is said when it cannot be had."""

import functools
import hashlib
import http.server
import re
import threading
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import pooch
import pytest
from folder_contents import refusal

from mereo.scenes.scene import AssetUnavailable
from mereo_objects import assets
from mereo_objects.assets import ASSETS, Asset

CONTENT = b"OFF\n0 0 0\n"


@pytest.fixture(autouse=True)
def empty_cache(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, request: pytest.FixtureRequest) -> Path:
    """No mirror, no cached files: the state of a fresh machine (real files are asked for before)."""
    if "require_asset" not in request.fixturenames:
        monkeypatch.delenv(assets.MIRROR_VARIABLE, raising=False)
        monkeypatch.setattr(assets, "_cache", lambda: tmp_path / "cache")
    return tmp_path / "cache"


@pytest.fixture
def server(tmp_path: Path) -> Iterator[str]:
    """A web server on this machine that serves ``tmp_path / "web"``; yields its address."""
    (tmp_path / "web").mkdir()
    handler = functools.partial(http.server.SimpleHTTPRequestHandler, directory=tmp_path / "web")
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as web:
        thread = threading.Thread(target=web.serve_forever, args=(0.01,))
        thread.start()
        yield f"http://127.0.0.1:{web.server_port}"
        web.shutdown()
        thread.join()


def register(monkeypatch: pytest.MonkeyPatch, url: str) -> Asset:
    digest = hashlib.sha256(CONTENT).hexdigest()
    asset = replace(ASSETS["bunny/bunny.off"], name="toy/toy.off", url=url, sha256=digest)
    monkeypatch.setattr(assets, "ASSETS", {asset.name: asset})
    return asset


@pytest.mark.parametrize("name", sorted(ASSETS))
def test_real_files_have_the_declared_hash(name: str, require_asset: Callable[[str], Path]) -> None:
    assert require_asset(name).is_file(), "which is checked on the way"


def test_mirror_comes_first_and_is_checked(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    asset = register(monkeypatch, "http://127.0.0.1:9/toy.off")
    monkeypatch.setenv("MEREO_ASSETS", str(tmp_path / "mirror"))
    path = tmp_path / "mirror" / asset.name
    path.parent.mkdir(parents=True)
    path.write_bytes(CONTENT)
    assert assets.get(asset.name) == path == assets.location(asset.name)
    path.write_bytes(CONTENT + b"changed")
    found = hashlib.sha256(CONTENT + b"changed").hexdigest()
    with pytest.raises(ValueError, match="delete it to download the right one") as caught:
        assets.get(asset.name)
    assert all(part in str(caught.value) for part in (str(path), found, asset.sha256))


def test_one_download_is_kept(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, server: str, empty_cache: Path) -> None:
    asset = register(monkeypatch, f"{server}/toy.off")
    (tmp_path / "web" / "toy.off").write_bytes(CONTENT)
    assert assets.location(asset.name) is None
    path = assets.get(asset.name)
    assert path == empty_cache / asset.name and path.read_bytes() == CONTENT
    (tmp_path / "web" / "toy.off").unlink()
    assert assets.get(asset.name) == path == assets.location(asset.name)


def test_a_wrong_download_leaves_nothing(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, server: str, empty_cache: Path
) -> None:
    asset = register(monkeypatch, f"{server}/toy.off")
    with pytest.raises(AssetUnavailable, match=r"download of toy/toy.off failed \(HTTPError\).*MEREO_ASSETS"):
        assets.get(asset.name)
    (tmp_path / "web" / "toy.off").write_bytes(b"a log-in page")
    with pytest.raises(AssetUnavailable, match="is not toy/toy.off"):
        assets.get(asset.name)
    assert not [path for path in empty_cache.rglob("*") if path.is_file()]


def test_no_network_is_one_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    asset = register(monkeypatch, "http://127.0.0.1:9/toy.off")  # the discard port: refused
    with refusal("cannot be reached: put the file from .* set MEREO_ASSETS", AssetUnavailable):
        assets.get(asset.name)


def test_a_silent_network_is_given_up_while_it_is_silent(monkeypatch: pytest.MonkeyPatch) -> None:
    """A look-up that hangs has no time limit of its own, so the limit must hold without its help."""
    asset = register(monkeypatch, "http://127.0.0.1:9/toy.off")
    release, ended = threading.Event(), threading.Event()

    monkeypatch.setattr(assets, "ANSWER_SECONDS", 0.2)
    monkeypatch.setattr(pooch.HTTPDownloader, "__call__", lambda *_, **__: release.wait(60) and ended.set())
    with pytest.raises(AssetUnavailable, match="cannot be reached"):
        assets.get(asset.name)
    assert not ended.is_set()
    release.set()


def test_every_entry_is_complete_and_pinned_to_a_commit() -> None:
    for name, asset in ASSETS.items():
        assert name == asset.name and re.fullmatch(r"[a-z]+/[A-Za-z0-9_]+\.[a-z]+", name)
        assert re.fullmatch(r"[0-9a-f]{64}", asset.sha256)
        assert re.fullmatch(r"https://[^ ]+/[0-9a-f]{40}/[^ ]+", asset.url)
        assert asset.url.rsplit(".", 1)[1] == name.rsplit(".", 1)[1]
        assert asset.licence and asset.credit and asset.description
    assert len({asset.sha256 for asset in ASSETS.values()}) == len({a.url for a in ASSETS.values()}) == len(ASSETS)


def test_an_unknown_name_and_a_mirror_that_is_no_folder_are_errors(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ValueError, match="no asset 'bunny'; known names are printed by: mereo assets list"):
        assets.get("bunny")
    monkeypatch.setenv("MEREO_ASSETS", "/absent")
    with pytest.raises(AssetUnavailable, match="not a folder: correct or unset it"):
        assets.get("bunny/bunny.off")


def test_unwritable_cache_is_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, server: str) -> None:
    asset = register(monkeypatch, f"{server}/toy.off")
    (tmp_path / "web" / "toy.off").write_bytes(CONTENT)
    (tmp_path / "file").write_text("in the way")
    monkeypatch.setattr(assets, "_cache", lambda: tmp_path / "file")
    with pytest.raises(AssetUnavailable, match="cannot be stored at .*file.*XDG_CACHE_HOME"):
        assets.get(asset.name)
