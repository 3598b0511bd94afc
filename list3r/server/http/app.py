"""The requests that a catalogue answers over HTTP."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from typing import Annotated, Any

from fastapi import Depends, FastAPI, Query, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse, PlainTextResponse
from pydantic import BaseModel, Field
from starlette.exceptions import HTTPException

from list3r import __version__
from list3r.catalog import Catalog
from list3r.catalog.catalog import MOST_ANSWERS
from list3r.catalog.records import CatalogError, CatalogFilters, UnknownMemoryError
from list3r.cli.answer import SCHEMA
from list3r.memory.core.errors import List3rError, UnknownIdError
from list3r.server.http.limits import Application, Guard, Metrics, ServiceLimits, error_answer

CATALOG_VARIABLE, SECRET_VARIABLE = "LIST3R_CATALOG", "LIST3R_SERVE_SECRET"
TIMEOUT_VARIABLE = "LIST3R_SERVE_TIMEOUT_S"
"""How the process that starts a service passes on its time limit."""

Text = Annotated[str, Query(min_length=1, max_length=500)]
Maybe = Annotated[str | None, Query(max_length=500)]
Number = Annotated[float | None, Query(allow_inf_nan=False)]
Instance = Annotated[int, Query(ge=0, le=2**63 - 1)]
InstanceId = Annotated[int | None, Query(ge=0, le=2**63 - 1)]
Corner = Annotated[list[float] | None, Query(max_length=3)]


class Page(BaseModel):
    """Which of the answers."""

    offset: Annotated[int, Field(ge=0, lt=MOST_ANSWERS)] = 0
    limit: Annotated[int, Field(ge=1, le=MOST_ANSWERS)] = 20


class Which(BaseModel):
    """Which instances may answer."""

    min_confidence: Annotated[float, Field(ge=0.0, le=1.0)] = 0.0
    state: Annotated[str | None, Field(max_length=20)] = None
    structure: bool = False

    def filters(self) -> CatalogFilters:
        """Return them as the catalogue takes them."""
        return CatalogFilters(self.structure, self.min_confidence, self.state)


class Vector(BaseModel):
    """A vector to compare with."""

    vector: Annotated[list[float], Field(min_length=1, max_length=4000)]
    space: Annotated[str, Field(max_length=200)]
    memory: Annotated[str | None, Field(max_length=200)] = None
    limit: Annotated[int, Field(ge=1, le=MOST_ANSWERS)] = 20


@dataclass(frozen=True)
class Point:
    """A point, metres or units of the memory."""

    x: Number = None
    y: Number = None
    z: Number = None


@dataclass(frozen=True)
class Bounds:
    """A box (`lower`, `upper`) or a sphere (`center`, `radius`); numbers of a corner one by one."""

    lower: Corner = None
    upper: Corner = None
    center: Corner = None
    radius: Number = None


Paged = Annotated[Page, Depends()]
Filtered = Annotated[Which, Depends()]


def make_service(catalog: Catalog, secret: str, limits: ServiceLimits | None = None) -> Application:
    """Return the application of a catalogue; clients must send a token of the `secret`."""
    limits, metrics = limits or ServiceLimits(), Metrics()
    app = FastAPI(title="list3r", version=__version__, docs_url=None, redoc_url=None, openapi_url="/v1/openapi.json")
    state, asked = _Health(catalog, metrics), _Questions(catalog, limits)
    for path, answer in (("/health", state.health), ("/ready", state.ready), ("/metrics", state.counts)):
        app.add_api_route(path, answer)
    for path, ask in (
        ("/v1/memories", asked.memories),
        ("/v1/memories/{name}", asked.memory),
        ("/v1/memories/{name}/nearest", asked.nearest),
        ("/v1/memories/{name}/within", asked.within),
        ("/v1/memories/{name}/similar", asked.similar),
        ("/v1/find", asked.find),
        ("/v1/relations", asked.relations),
    ):
        app.add_api_route(path, ask)
    app.add_api_route("/v1/similar", asked.alike, methods=["POST"])
    app.add_exception_handler(List3rError, _explained)
    app.add_exception_handler(RequestValidationError, _misread)
    app.add_exception_handler(HTTPException, _unrouted)
    app.add_exception_handler(Exception, _failed)
    return Guard(app, secret, limits, metrics)


def from_environment() -> Application:
    """Return the application of a process of a service; catalogue and secret come from its environment."""
    limits = ServiceLimits(request_s=float(os.environ[TIMEOUT_VARIABLE]))
    catalog = Catalog.open(os.environ[CATALOG_VARIABLE], limits.connections)
    return make_service(catalog, os.environ[SECRET_VARIABLE], limits)


class _Health:
    """How the service is."""

    def __init__(self, catalog: Catalog, metrics: Metrics) -> None:
        self._catalog, self._metrics = catalog, metrics

    async def health(self) -> dict[str, str]:
        """Whether this process answers."""
        return {"status": "ok"}

    def ready(self) -> JSONResponse:
        """Whether the database answers too."""
        alive = self._catalog.alive()
        return JSONResponse({"status": "ok" if alive else "no database"}, 200 if alive else 503)

    async def counts(self) -> PlainTextResponse:
        """Counts of this process, for Prometheus."""
        return PlainTextResponse(self._metrics.text())


class _Questions:
    """Questions to the catalogue, one method a path."""

    def __init__(self, catalog: Catalog, limits: ServiceLimits) -> None:
        self._catalog, self._limits = catalog, limits

    def memories(self, page: Paged) -> dict[str, Any]:
        """All memories by name."""
        found = self._catalog.memories()
        return self._paged(found, page, total=len(found))

    def memory(self, name: str) -> dict[str, Any]:
        """One memory."""
        return _answer([asdict(self._catalog.memory(name))])

    def find(self, text: Text, page: Paged, which: Filtered, memory: Maybe = None) -> dict[str, Any]:
        """Instances by a phrase, in one memory or over all."""
        found = self._catalog.find(text, memory, k=self._wanted(page), filters=which.filters())
        return self._paged(found, page, found.notes, **found.facts())

    def nearest(
        self, name: str, page: Paged, which: Filtered, at: Annotated[Point, Depends()], id: InstanceId = None
    ) -> dict[str, Any]:
        """Instances nearest to a point or an instance."""
        point: Any = None if at == Point() else (at.x, at.y, at.z)
        k = self._wanted(page)
        found = self._catalog.nearest(name, point=point, instance_id=id, k=k, filters=which.filters())
        return self._paged(found, page, found.notes)

    def within(self, name: str, page: Paged, which: Filtered, bounds: Annotated[Bounds, Depends()]) -> dict[str, Any]:
        """Instances in a box or a sphere."""
        sides: dict[str, Any] = asdict(bounds)
        found = self._catalog.within(name, **sides, filters=which.filters())
        return self._paged(found, page, found.notes, total=len(found))

    def similar(
        self, name: str, id: Instance, page: Paged, which: Filtered, everywhere: bool = False
    ) -> dict[str, Any]:
        """Instances that look like one of a memory."""
        k = self._wanted(page)
        found = self._catalog.similar(name, instance_id=id, anywhere=everywhere, k=k, filters=which.filters())
        return self._paged(found, page, found.notes)

    def alike(self, body: Vector) -> dict[str, Any]:
        """Instances whose vectors are like one, over all memories or in one."""
        page, anywhere = Page(limit=body.limit), body.memory is None
        k = self._wanted(page)
        found = self._catalog.similar(body.memory, vector=body.vector, space=body.space, anywhere=anywhere, k=k)
        return self._paged(found, page, found.notes)

    def relations(
        self, page: Paged, memory: Maybe = None, subject: Maybe = None, predicate: Maybe = None, object: Maybe = None
    ) -> dict[str, Any]:
        """Stored relations, in one memory or over all."""
        k = self._wanted(page)
        found = self._catalog.relations(memory, subject=subject, predicate=predicate, object=object, k=k)
        return self._paged(found, page, found.notes)

    def _wanted(self, page: Page) -> int:
        """Return the number of answers for a page, and one more: it shows whether another page follows."""
        return min(page.offset + self._limit(page) + 1, MOST_ANSWERS)

    def _limit(self, page: Page) -> int:
        return min(page.limit, self._limits.answers)

    def _paged(self, found: Sequence[Any], page: Page, notes: Iterable[str] = (), **facts: Any) -> dict[str, Any]:
        """Return one page of the answers; `next` is the offset of the next one, null at the end."""
        end = page.offset + self._limit(page)
        following = end if len(found) > end else None
        return _answer([asdict(m) for m in found[page.offset : end]], notes, next=following, **facts)


def _answer(matches: Sequence[Any], notes: Iterable[str] = (), **facts: Any) -> dict[str, Any]:
    return {"schema": SCHEMA, "units": None, "matches": list(matches), "notes": list(notes), **facts}


async def _explained(request: Request, error: Exception) -> JSONResponse:
    """The user's errors are 400, absent resources 404, and a catalogue that does not answer 503."""
    unknown = isinstance(error, UnknownIdError | UnknownMemoryError)
    status = 404 if unknown else 503 if isinstance(error, CatalogError) else 400
    return JSONResponse(error_answer(status, type(error).__name__, str(error)), status)


async def _unrouted(request: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, HTTPException)
    said = f"{request.method} {request.url.path[:100]}: {error.detail}; /v1/openapi.json lists the requests"
    return JSONResponse(error_answer(error.status_code, "RequestError", said), error.status_code)


async def _failed(request: Request, error: Exception) -> JSONResponse:
    return JSONResponse(error_answer(500, "ServiceError", "the service failed; its log says why"), 500)


async def _misread(request: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, RequestValidationError)
    said = "; ".join(f"{'.'.join(map(str, e['loc'][1:]))}: {e['msg']}" for e in error.errors())
    return JSONResponse(error_answer(422, "OptionError", said), 422)
