"""A model hub on this machine: as much of the Hugging Face Hub's HTTP interface as pushing and pulling weights needs.

Repositories are dictionaries of files, one for each commit. Large files come as on the hub: the client asks where to
(git LFS's batch request), puts them there, and the commit names them by their SHA-256.
"""

import base64
import hashlib
import json
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from urllib.parse import unquote, urlsplit

Files = dict[str, bytes]

TOKEN = "hf_of_this_test"


class ModelHub(ThreadingHTTPServer):
    """The server and what it holds: repositories by name, their commits by revision, and large files by hash."""

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), _Handler)
        self.repos: dict[str, dict[str, Files]] = {}
        self.private: set[str] = set()
        self.large: dict[str, bytes] = {}
        self.said_sizes: dict[str, int] = {}
        self.requests: list[str] = []

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server_port}"

    def put(self, repo: str, files: Files, *revisions: str) -> str:
        """A commit with these files, which is the main branch and these revisions; returns its hash."""
        commit = hashlib.sha1(repr(sorted(files.items())).encode()).hexdigest()
        for revision in ("main", commit, *revisions):
            self.repos.setdefault(repo, {"main": {}})[revision] = files
        return commit


@contextmanager
def model_hub() -> Iterator[ModelHub]:
    """A running hub, empty at first."""
    with ModelHub() as hub:
        thread = threading.Thread(target=hub.serve_forever, args=(0.01,))
        thread.start()
        try:
            yield hub
        finally:
            hub.shutdown()
            thread.join()


class _Handler(BaseHTTPRequestHandler):
    server: ModelHub
    protocol_version = "HTTP/1.1"

    def log_message(self, format: str, *args: object) -> None:
        pass

    def do_HEAD(self) -> None:
        self._route()

    do_GET = do_POST = do_PUT = do_HEAD

    def _route(self) -> None:
        length = int(self.headers.get("Content-Length") or 0)
        body = self._chunks() if self.headers.get("Transfer-Encoding") == "chunked" else self.rfile.read(length)
        parts = [unquote(part) for part in urlsplit(self.path).path.strip("/").split("/")]
        self.server.requests.append(f"{self.command} {self.path}")
        writes = self.command in ("POST", "PUT")
        if writes and self.headers.get("Authorization") != f"Bearer {TOKEN}" and parts[0] != "large":
            self._error(401, "", "Invalid username or password.")
        elif parts[:3] == ["api", "repos", "create"]:
            self._create(json.loads(body))
        elif parts[:2] == ["api", "validate-yaml"]:
            self._json({"errors": [], "warnings": []})
        elif parts[:2] == ["api", "models"]:
            self._api("/".join(parts[2:4]), parts[4:], body)
        elif parts[-2:] == ["objects", "batch"]:
            self._batch(json.loads(body))
        elif parts[0] == "large":
            self.server.large[parts[1]] = body
            self._answer(200, b"")
        elif parts[2:3] != ["resolve"]:
            self._error(404, "", "Not found")
        else:
            self._resolve("/".join(parts[:2]), parts[3], "/".join(parts[4:]))

    def _chunks(self) -> bytes:
        found = b""
        while size := int(self.rfile.readline(), 16):
            found += self.rfile.read(size)
            self.rfile.readline()
        self.rfile.readline()
        return found

    def _create(self, wanted: dict[str, object]) -> None:
        repo = "/".join(str(wanted[key]) for key in ("organization", "name") if wanted.get(key))
        there = repo in self.server.repos
        if not there:
            self.server.put(repo, {})
            if wanted.get("visibility") == "private":
                self.server.private.add(repo)
        self._json({"url": f"{self.server.url}/{repo}"}, 409 if there else 200)

    def _api(self, repo: str, rest: list[str], body: bytes) -> None:
        kind, revision = (*rest, "main")[:2] if len(rest) > 1 else ("revision", "main")
        files = self._files(repo, revision)
        if files is None:
            return
        if kind == "preupload":
            asked = json.loads(body)["files"]
            mode = {True: "lfs", False: "regular"}
            modes = [(file["path"], mode[file["path"].endswith(".safetensors")]) for file in asked]
            self._json({"files": [{"path": p, "uploadMode": m, "shouldIgnore": False} for p, m in modes]})
        elif kind == "commit":
            commit = self.server.put(repo, files | dict(self._added(body)), revision)
            self._json({"commitUrl": f"{self.server.url}/{repo}/commit/{commit}", "commitOid": commit})
        else:
            sizes = self.server.said_sizes
            siblings = [{"rfilename": name, "size": sizes.get(name, len(content))} for name, content in files.items()]
            self._json({"id": repo, "sha": self._commit(repo, files), "siblings": siblings, "tags": []})

    def _added(self, body: bytes) -> Iterator[tuple[str, bytes]]:
        for line in map(json.loads, body.splitlines()):
            value = line["value"]
            if line["key"] == "file":
                yield value["path"], base64.b64decode(value["content"])
            elif line["key"] == "lfsFile":
                assert hashlib.sha256(self.server.large[value["oid"]]).hexdigest() == value["oid"]
                yield value["path"], self.server.large[value["oid"]]

    def _batch(self, wanted: dict[str, list[dict[str, object]]]) -> None:
        objects = [
            {**o, "actions": {"upload": {"href": f"{self.server.url}/large/{o['oid']}", "header": {}}}}
            for o in wanted["objects"]
        ]
        self._json({"transfer": "basic", "objects": objects})

    def _resolve(self, repo: str, revision: str, name: str) -> None:
        files = self._files(repo, revision)
        if files is not None and name not in files:
            self._error(404, "EntryNotFound", "Entry not found")
        elif files is not None:
            etag = hashlib.sha256(files[name]).hexdigest()
            self._answer(200, files[name], {"ETag": f'"{etag}"', "X-Repo-Commit": self._commit(repo, files)})

    def _files(self, repo: str, revision: str) -> Files | None:
        if repo not in self.server.repos:
            self._error(404, "RepoNotFound", "Repository not found")
        elif revision not in self.server.repos[repo]:
            self._error(404, "RevisionNotFound", f"Invalid rev id: {revision}")
        else:
            return self.server.repos[repo][revision]
        return None

    def _commit(self, repo: str, files: Files) -> str:
        return next(key for key, found in self.server.repos[repo].items() if found == files and len(key) == 40)

    def _json(self, value: object, status: int = 200) -> None:
        self._answer(status, json.dumps(value).encode(), {"Content-Type": "application/json"})

    def _error(self, status: int, code: str, text: str) -> None:
        self._answer(status, b"", {"X-Error-Code": code, "X-Error-Message": text})

    def _answer(self, status: int, content: bytes, headers: dict[str, str] | None = None) -> None:
        self.send_response(status)
        for key, value in {"Content-Length": str(len(content)), **(headers or {})}.items():
            self.send_header(key, value)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(content)
