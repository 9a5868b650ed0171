"""Meshes and scans that are downloaded on demand, each with its origin, hash and licence.

None of them is part of the package. ``get`` looks in the folder that the environment variable ``MEREO_ASSETS`` names
(same file names), then in the user's cache, then downloads. Every file is checked against its SHA-256 each time.
"""

import hashlib
import os
import threading
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from urllib.parse import urlsplit

from mereo.scenes.scene import AssetUnavailable

MIRROR_VARIABLE = "MEREO_ASSETS"
ANSWER_SECONDS = 4.0
"""A server that says nothing for this long counts as unreachable: no network is to be noticed at once."""
STALL_SECONDS = 20.0
"""A download that delivers nothing for this long is given up."""


@dataclass(frozen=True)
class Asset:
    """Downloadable file with its origin, hash and licence.

    Attributes:
        name: path below the mirror and the cache, for example ``bunny/bunny.off``.
        url: origin, pinned to a commit.
        sha256: of the file's bytes, in hexadecimal.
        licence: terms of use.
        credit: who is to be named.
        description: what it is, with its units.
    """

    name: str
    url: str
    sha256: str
    licence: str
    credit: str
    description: str


_RAW = "https://raw.githubusercontent.com/"
_SCANS = _RAW + "dengnantianjie/3dcoursework/fdabb8f051a5e2b209fe9e5ac5fe989588413f3c/bunny/data/"
_CHIN = (
    _RAW + "somanshu25/GPU-Accelerated-Point-Cloud-Registration-Using-Hierarchical-GMM/"
    "aea340b32157e800b4c80165e0664960f837ebfb/data/"
)
_LAPGYM = _RAW + "ScheiklP/sofa_env/85bf7e05dd088b824794dda0046679df13b13e6e/sofa_env/scenes/grasp_lift_touch/meshes/"
_MAKEHUMAN = _RAW + "makehumancommunity/makehuman/a8bc2d54ff0ac92e78ff71431b1023eda42bf482/makehuman/data/"
_SOFA = _RAW + "sofa-framework/sofa/2a278d891fe68ae5a835259bd62a2844df1670a1/examples/Demos/Dentistry/data/mesh/"

_STANFORD = (
    "Stanford 3D Scanning Repository terms: research use, free redistribution, credit, not commercial",
    "Stanford Computer Graphics Laboratory",
)
_MIT = ("MIT", "(c) 2023 Paul Scheikl, LapGym")
_CC0 = ("CC0 1.0", "MakeHuman community")
_LGPL = ("LGPL-2.1-or-later", "SOFA framework")

_ALL = (
    Asset(
        "bunny/bunny.off",
        _RAW + "libigl/libigl-tutorial-data/c1f9ede366d02e3531ecbaec5e3769312f31cccd/bunny.off",
        "dda85ca6dc03ed83a0b754611d5c0b1a3c8ba5234e690479ac4a04063e6a7d4d",
        *_STANFORD,
        "Stanford bunny, watertight, 6,966 faces, metres",
    ),
    Asset(
        "bunny/bun000.ply",
        _SCANS + "bun000.ply",
        "688d6b5ef4f8aebaeed9af9ed1605b6f4985a8e845ff5c015924f9b1d13f4b05",
        *_STANFORD,
        "real Cyberware range scan from the front, metres",
    ),
    Asset(
        "bunny/bun090.ply",
        _SCANS + "bun090.ply",
        "1eaabf4c24aac4f02d42fcc64ba1dc0b817b0575aca6bf61aa50a96ac464facd",
        *_STANFORD,
        "real Cyberware range scan, turned by 90 degrees, metres",
    ),
    Asset(
        "bunny/bun270.ply",
        _SCANS + "bun270.ply",
        "a97009be31db07947c28658ba208207f1edde7556f3892536c54bb514420bf16",
        *_STANFORD,
        "real Cyberware range scan, turned by 270 degrees, metres",
    ),
    Asset(
        "bunny/chin.ply",
        _CHIN + "chin.ply",
        "047401ae93d9b3c52c762364cc2ad1938ff40ffcc133a8acb54c81bd7a38c6c7",
        *_STANFORD,
        "real Cyberware range scan from below, metres",
    ),
    Asset(
        "liver/lapgym_liver_visual.stl",
        _LAPGYM + "liver_visual.stl",
        "6d3452d7b5e35408278f7041552b65de4553836865c58365adef3082eabaf819",
        *_MIT,
        "liver, 28,716 faces, millimetres; one open loop and stray fragments",
    ),
    Asset(
        "liver/lapgym_gallbladder_visual.stl",
        _LAPGYM + "gallbladder_visual.stl",
        "1e20fb3956f004cfdd48557b49e6bc12088d275597d6f0c7968efc87919f4a66",
        *_MIT,
        "gallbladder in the liver's frame, watertight, millimetres; overlaps the liver slightly",
    ),
    Asset(
        "liver/lapgym_liver_volumetric.vtk",
        _LAPGYM + "liver_volumetric.vtk",
        "40d1df54f2f4e7a8b01c7d3c2b91d5651b7e6c4765d11544bea5694afec25e6a",
        *_MIT,
        "liver as tetrahedra for finite elements, millimetres",
    ),
    Asset(
        "liver/lapgym_gallbladder_volumetric.vtk",
        _LAPGYM + "gallbladder_volumetric.vtk",
        "31bec8202724efe406474dea416a5e15e798caefccaff84e0570d57e116c3bdc",
        *_MIT,
        "gallbladder as tetrahedra, millimetres",
    ),
    Asset(
        "human/makehuman_base.obj",
        _MAKEHUMAN + "3dobjs/base.obj",
        "8e761e6624b8f54536409135d1636da63b32486a90d4897f84e121d144f6fb4c",
        *_CC0,
        "MakeHuman base mesh, decimetres; the group 'body' alone is watertight",
    ),
    Asset(
        "human/makehuman_default.mhskel",
        _MAKEHUMAN + "rigs/default.mhskel",
        "99f179bce0aa850b45d4191a1d0d234c5851f881c057439470ded3bddf729a24",
        *_CC0,
        "its skeleton, 163 bones; a joint is the mean of listed base vertices",
    ),
    Asset(
        "human/makehuman_default_weights.mhw",
        _MAKEHUMAN + "rigs/default_weights.mhw",
        "0f3641d651ae3d00ad6b4ccee43142edb109d3bd909d27d9e4139ef1beed8625",
        *_CC0,
        "its skin weights, 139 bones",
    ),
    Asset(
        "skull/sofa_skull_and_teeth_coarse.obj",
        _SOFA + "skull_and_teeth_coarse.obj",
        "c1021ae8ebc33656314cf01a60e750c8a7ef271c3f93f40423602805ede5e93c",
        *_LGPL,
        "cranium, mandible and 32 teeth; the roots overlap the bone",
    ),
)

ASSETS: Mapping[str, Asset] = MappingProxyType({asset.name: asset for asset in _ALL})
"""Every downloadable file by name."""


def get(name: str) -> Path:
    """Path of a checked local copy of the asset ``name``, downloaded if need be.

    Raises:
        ValueError: no asset has this name, or the mirror's file has another hash.
        AssetUnavailable: the mirror is not a folder, or there is no mirror, no cached file and no network.
    """
    if name not in ASSETS:
        raise ValueError(f"there is no asset {name!r}; known names are printed by: mereo assets list")
    asset = ASSETS[name]
    return _from_mirror(asset) or _from_cache(asset)


def location(name: str) -> Path | None:
    """Path where ``get`` would find the asset without a download (not yet checked), or None."""
    candidates = [Path(folder) / name for folder in (os.environ.get(MIRROR_VARIABLE), _cache()) if folder]
    return next((path for path in candidates if path.is_file()), None)


def _from_mirror(asset: Asset) -> Path | None:
    folder = os.environ.get(MIRROR_VARIABLE)
    if not folder:
        return None
    if not Path(folder).is_dir():
        raise AssetUnavailable(f"{MIRROR_VARIABLE} names {folder!r}, which is not a folder: correct or unset it")
    path = Path(folder) / asset.name
    if not path.is_file():
        return None
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    if digest != asset.sha256:
        raise ValueError(
            f"{path} has SHA-256 {digest}, but {asset.name} must have {asset.sha256}: "
            f"delete it to download the right one, or unset {MIRROR_VARIABLE}"
        )
    return path


def _cache() -> Path:
    import pooch

    return Path(pooch.os_cache("mereo"))


def _from_cache(asset: Asset) -> Path:
    """The cached file; downloaded first when it is missing or damaged."""
    import pooch

    cure = f"put the file from {asset.url} at {asset.name} in a folder and set {MIRROR_VARIABLE} to that folder"
    path = _cache() / asset.name
    if path.is_file() and pooch.file_hash(str(path)) == asset.sha256:
        return path
    if not _answers(asset.url):
        raise AssetUnavailable(f"{asset.name} is not here and {urlsplit(asset.url).hostname} cannot be reached: {cure}")
    pooch.get_logger().setLevel("WARNING")
    try:
        downloader = pooch.HTTPDownloader(timeout=(ANSWER_SECONDS, STALL_SECONDS))
        downloaded = pooch.retrieve(asset.url, f"sha256:{asset.sha256}", asset.name, _cache(), downloader=downloader)
    except ValueError as error:  # pooch: another hash; it has deleted the file
        raise AssetUnavailable(f"what {asset.url} delivers is not {asset.name} (another SHA-256): {cure}") from error
    except OSError as error:
        if error.errno is None:  # a download's; those of the file system have a number
            raise AssetUnavailable(f"the download of {asset.name} failed ({type(error).__name__}): {cure}") from error
        raise AssetUnavailable(
            f"{asset.name} cannot be stored at {path} ({error.strerror}): free space there, or set XDG_CACHE_HOME"
        ) from error
    return Path(downloaded)


def _answers(url: str) -> bool:
    """Whether the server says anything within ``ANSWER_SECONDS``.

    In a thread, because the time limit of a connection is per address of the host and name look-up has none at all.
    """
    import pooch

    answered: list[bool] = []

    def ask() -> None:
        try:
            pooch.HTTPDownloader(timeout=ANSWER_SECONDS)(url, None, None, check_only=True)
            answered.append(True)
        except OSError:
            pass

    thread = threading.Thread(target=ask, daemon=True)
    thread.start()
    thread.join(ANSWER_SECONDS)
    return bool(answered)
