"""Addresses of the server: frames in, figures or surfaces out; what is served; health and numbers.

POST /v1/{weights}/reconstruct -admit, take the body, submit-> Waiting -answer-> summary.json or segments.glb
"""

import asyncio
import secrets
import shutil
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Annotated, Any

from fastapi import FastAPI, Query, Request, Response
from fastapi import Path as InPath
from fastapi.exceptions import RequestValidationError
from fastapi.responses import HTMLResponse, JSONResponse
from prometheus_client.exposition import CONTENT_TYPE_LATEST
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect

from mereo_serving.bodies import MEDIA, SUFFIXES, take, too_large
from mereo_serving.config import ServeConfig
from mereo_serving.dispatcher import Dispatcher, Waiting
from mereo_serving.gate import Entry, Gate
from mereo_serving.messages import FAULT, GLB, JSON, FrameRequest, Media, Refused, Reply, failed
from mereo_serving.metrics import Metrics
from mereo_serving.options import FrameOptions, sentence_of
from mereo_serving.page import docs_page

GONE = 499
"""Status, as of nginx, of a request whose client has left."""

DESCRIPTION = """Every part of a deformable object, hidden side included, from one depth image or point cloud: POST a
frame to the weights of its object. Lengths are in the frame's unit, depth images are in metres, places are in the
camera's frame: x right, y down, z forward."""

PARTS: dict[str, dict[str, str]] = {
    "frame": {"format": "binary"},
    "mask": {"format": "binary"},
    "intrinsics": {"contentMediaType": JSON},
}

BODY = {
    "required": True,
    "content": {
        "application/octet-stream": {"schema": {"type": "string", "format": "binary"}},
        **{media: {"schema": {"type": "string", "format": "binary"}} for media in MEDIA},
        "multipart/form-data": {
            "schema": {
                "type": "object",
                "required": ["frame"],
                "properties": {name: {"type": "string", **more} for name, more in PARTS.items()},
            }
        },
    },
}

ANSWERS: dict[int | str, dict[str, Any]] = {
    200: {
        "description": "By Accept: figures as in summary.json of `mereo reconstruct`, or surfaces as in segments.glb",
        "content": {JSON: {}, GLB: {}},
    },
    400: {"description": "A form that cannot be read"},
    404: {"description": "Weights that are not served"},
    406: {"description": "An answer that there is none of"},
    408: {"description": "A body that has not come in time"},
    413: {"description": "A body, frame or point cloud that is too large"},
    415: {"description": "A format that is not read"},
    422: {
        "description": "A frame that cannot be answered, or wrong parameters: `error` is the command line's sentence"
    },
    429: {"description": "As many frames wait as may; Retry-After says when to ask again"},
    500: {"description": "A fault of the server, which it has logged"},
    503: {"description": "The server is being stopped"},
    504: {"description": "No answer in time"},
}

ALWAYS: dict[int | str, dict[str, Any]] = {200: {"description": "Always"}}
TEXT = CONTENT_TYPE_LATEST.partition(";")[0]


@dataclass(frozen=True, eq=False)
class Service:
    """All that the addresses need.

    Attributes:
        dispatcher: in front of the processes that answer.
        metrics: numbers.
        config: limits.
        root: folder in which each request gets one of its own.
        facts: of the weights.
        resolution: cells where a request does not say.
        entry: the address, and its token.
    """

    dispatcher: Dispatcher
    metrics: Metrics
    config: ServeConfig
    root: Path
    facts: Sequence[dict[str, Any]]
    resolution: int = 128
    entry: Entry = field(default_factory=Entry)

    @property
    def names(self) -> list[str]:
        """Names of the weights."""
        return [facts["name"] for facts in self.facts]

    async def answer(self, request: Request, weights: str, options: FrameOptions) -> Response:
        """Answer to a frame; raises ``Refused``."""
        if weights not in self.names:
            raise Refused(404, f"no weights {weights[:60]!a} are served; there are {', '.join(self.names)}: name one")
        media = media_of(request.headers.get("accept", "*/*"))
        resolution = options.cells(self.resolution, self.config.max_resolution)
        isolation = options.isolation()
        options.reading(self.root, None, None)  # what is wrong with it is said before the body comes
        if int(request.headers.get("content-length", 0)) > self.config.max_body:
            raise too_large(self.config.max_body)
        place = self.dispatcher.admit()
        folder = self.root / secrets.token_hex(8)
        try:
            folder.mkdir()
            kind = request.headers.get("content-type", "")
            taken = await take(
                request.stream(), kind, options.format, folder, self.config.max_body, self.config.timeout
            )
            intrinsics = _written(options.intrinsics, taken.intrinsics, folder)
            reading = options.reading(folder, intrinsics, taken.mask)
            frame = FrameRequest(weights, folder, taken.frame, reading, isolation, resolution, media, options.joints)
            waiting = self.dispatcher.submit(frame, place)
        except BaseException:
            place.leave()
            shutil.rmtree(folder, ignore_errors=True)
            raise
        return response_of(await self._awaited(waiting, request))

    async def _awaited(self, waiting: Waiting, request: Request) -> Reply:
        """Reply to a frame that waits, or what is said when its client or its time is gone."""
        gone = asyncio.create_task(_until_gone(request))
        try:
            either: set[asyncio.Future[Any]] = {gone, waiting.answer}
            await asyncio.wait(either, timeout=self.config.timeout, return_when=asyncio.FIRST_COMPLETED)
        finally:
            left = gone.done()
            gone.cancel()
        if waiting.answer.done():
            return waiting.answer.result()
        self.dispatcher.drop(waiting, "gone" if left else "timeout")
        if left:
            return Reply(GONE, b"")
        return failed(
            504, f"the frame was not answered within {self.config.timeout:g} s: ask again, or for fewer cells"
        )


def make_app(service: Service) -> Any:
    """ASGI application of a service; its lifespan starts and ends the dispatcher."""

    @asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[None]:
        service.dispatcher.start()
        yield
        await service.dispatcher.close()

    app = FastAPI(title="mereo", description=DESCRIPTION, docs_url=None, redoc_url=None, lifespan=lifespan)

    @app.post(
        "/v1/{weights}/reconstruct", response_class=Response, responses=ANSWERS, openapi_extra={"requestBody": BODY}
    )
    async def reconstruct(
        request: Request,
        weights: Annotated[str, InPath(description="Name of the object's weights, one of /v1/weights")],
        options: Annotated[FrameOptions, Query()],
    ) -> Response:
        """All segments of the object in a frame, a depth image or point cloud, in the frame's own axes and unit."""
        return await service.answer(request, weights, options)

    @app.get("/v1/weights", responses=ALWAYS)
    async def weights() -> JSONResponse:
        """What is served: names, segments, and what is known of how far the answers can be trusted."""
        return JSONResponse({"weights": list(service.facts), "formats": list(SUFFIXES)})

    @app.get("/healthz", responses=ALWAYS)
    async def healthz() -> JSONResponse:
        """Whether the server's process runs."""
        return JSONResponse({"status": "ok"})

    @app.get("/readyz", responses={200: {"description": "Ready"}, 503: {"description": "Not ready"}})
    async def readyz() -> JSONResponse:
        """Whether frames are taken and there is a process to answer them (503 where not)."""
        ready = service.dispatcher.ready
        return JSONResponse({"status": "ready" if ready else "not ready"}, 200 if ready else 503)

    @app.get("/metrics", response_class=Response, responses={200: {"description": "Always", "content": {TEXT: {}}}})
    async def metrics() -> Response:
        """Numbers for Prometheus: requests by code, what waits, seconds of each stage."""
        return Response(service.metrics.text(), media_type=CONTENT_TYPE_LATEST)

    @cache
    def page() -> str:
        return docs_page(app.openapi())

    @app.get("/docs", include_in_schema=False)
    async def docs() -> HTMLResponse:
        return HTMLResponse(page())

    _say_errors_in_sentences(app)
    return Gate(app, service.entry, service.metrics, service.config.max_body)


def _say_errors_in_sentences(app: FastAPI) -> None:
    @app.exception_handler(Refused)
    async def refused(_: Request, error: Refused) -> Response:
        return response_of(error.reply)

    @app.exception_handler(RequestValidationError)
    async def invalid(_: Request, error: RequestValidationError) -> Response:
        return response_of(failed(422, sentence_of(error.errors()[0])))

    @app.exception_handler(HTTPException)
    async def nowhere(request: Request, error: HTTPException) -> Response:
        text = f"{request.method} {request.url.path[:100]!a} is not known ({error.detail}); /docs lists what there is"
        return response_of(failed(error.status_code, text, error.headers))

    @app.exception_handler(ClientDisconnect)
    async def left(_: Request, error: ClientDisconnect) -> Response:
        return Response(status_code=GONE)

    @app.exception_handler(Exception)
    async def fault(_: Request, error: Exception) -> Response:
        return response_of(failed(500, FAULT))


def response_of(reply: Reply) -> Response:
    """Reply as FastAPI sends it."""
    return Response(reply.body, reply.status, dict(reply.headers), reply.media)


def media_of(accept: str) -> Media:
    """First media type that a client names, figures where it takes anything; raises ``Refused`` (406)."""
    for part in accept.lower().split(","):
        kind = part.partition(";")[0].strip()
        if kind in (GLB, "model/*"):
            return GLB
        if kind in (JSON, "application/*", "*/*"):
            return JSON
    raise Refused(406, f"Accept is {accept[:60]!a}; an answer is {JSON} or {GLB}: ask for one of them")


def _written(text: str | None, part: str | None, folder: Path) -> str | None:
    """Name of the file of intrinsics, of a part or of this text; raises ``Refused`` (422) where there are both."""
    if text is None:
        return part
    if part is not None:
        raise Refused(422, "intrinsics are given twice, in the address and as a part: leave one out")
    name = "intrinsics.json"
    (folder / name).write_text(text, "utf-8")
    return name


async def _until_gone(request: Request) -> None:
    """Wait until the client has left; its body has come."""
    while (await request.receive())["type"] != "http.disconnect":
        pass
