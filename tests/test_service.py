"""A catalogue over HTTP, as clients meet it: a real process, real connections, good and bad ones."""

from __future__ import annotations

import contextlib
import http.client
import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote, urlsplit

import pytest

from list3r.catalog import Catalog
from list3r.memory.core.errors import OptionError
from list3r.memory.store.store import Store
from list3r.server.http.tokens import make_token, refusal
from tests.conftest import write_small_room

SECRET = "a secret of the tests, long enough"
TIMEOUT_S = 2.0


@dataclass
class Service:
    """A service that runs."""

    port: int
    process: subprocess.Popen[str]
    slow: list[socket.socket]
    """Clients that have sent half of their headers, or of their body, since the service began."""

    def get(self, path: str, token: str | None = None, method: str = "GET", body: Any = None) -> tuple[int, Any]:
        """Ask; the status and the answer."""
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=30)
        token = make_token(SECRET, 1.0) if token is None else token
        headers = {"Authorization": f"Bearer {token}", "Content-Type": "application/json"} if token else {}
        connection.request(method, path, body=None if body is None else json.dumps(body), headers=headers)
        answer = connection.getresponse()
        text = answer.read().decode()
        connection.close()
        return answer.status, json.loads(text) if "json" in answer.headers["content-type"] else text


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    pytest.importorskip("fastapi", reason="fastapi is not installed: pip install '.[serve]'")
    folder = tmp_path_factory.mktemp("service")
    with Catalog.open(str(folder / "catalog.sqlite")) as catalog:
        for name in ("one", "two"):
            with Store.create(folder / f"{name}.l3r") as store, store.transaction():
                write_small_room(store)
            catalog.add(folder / f"{name}.l3r")
    words = ["serve", "--catalog", str(folder / "catalog.sqlite"), "--port", "0", "--timeout", str(TIMEOUT_S)]
    process = subprocess.Popen(
        [sys.executable, "-m", "list3r", *words],
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "LIST3R_SERVE_SECRET": SECRET},
    )
    assert process.stderr is not None
    port = urlsplit(process.stderr.readline().strip()).port or 0
    found = Service(port, process, [])
    deadline = time.monotonic() + 60
    while time.monotonic() < deadline:
        try:
            assert found.get("/health", token="") == (200, {"status": "ok"})
            break
        except (ConnectionError, http.client.HTTPException):
            time.sleep(0.1)
    begun = f"POST /v1/similar HTTP/1.1\r\nHost: a\r\nAuthorization: Bearer {make_token(SECRET, 1.0)}\r\n"
    for text in ("GET /v1/memories HTTP/1.1\r\nHos", f"{begun}Content-Length: 1000\r\n\r\n{{"):
        found.slow.append(socket.create_connection(("127.0.0.1", port), timeout=30))
        found.slow[-1].sendall(text.encode())
    yield found
    for client in found.slow:
        client.close()
    process.kill()
    process.wait()


def test_questions_are_answered_in_the_envelope(service: Service) -> None:
    status, found = service.get("/v1/find?text=mug+on+table&limit=3")
    assert (status, found["schema"], found["next"]) == (200, "list3r/answer/1", 3)
    assert [(m["memory"], m["id"]) for m in found["matches"]] == [("one", 3), ("one", 4), ("two", 3)]
    rest = service.get("/v1/find?text=mug+on+table&limit=3&offset=3")[1]
    assert ([(m["memory"], m["id"]) for m in rest["matches"]], rest["next"]) == ([("two", 4)], None)
    names = [m["name"] for m in service.get("/v1/memories")[1]["matches"]]
    assert names == ["one", "two"]
    near = service.get("/v1/memories/two/nearest?x=2&y=1&z=0.4&limit=1")[1]["matches"][0]
    assert (near["memory"], near["id"], near["distance"], near["stale"]) == ("two", 5, 0.0, False)
    inside = service.get("/v1/memories/one/within?center=2&center=1&center=0.4&radius=0.3")[1]
    assert [m["id"] for m in inside["matches"]] == [5]
    alike = service.get("/v1/memories/one/similar?id=3&everywhere=true&limit=1")[1]["matches"]
    assert [(m["memory"], m["id"]) for m in alike] == [("two", 3)]
    vector = [1.0] + [0.0] * 15
    assert (
        len(service.get("/v1/similar", method="POST", body={"vector": vector, "space": "test@1/16"})[1]["matches"]) == 8
    )
    stored = service.get("/v1/relations?subject=mug&predicate=on&memory=one")[1]["matches"]
    assert [(r["subject"], r["object_name"]) for r in stored] == [(3, "table"), (4, "table")]


def test_tokens_that_do_not_hold_are_refused(service: Service) -> None:
    other, old = make_token("another secret, as long", 1.0), make_token(SECRET, 1.0, now_s=time.time() - 7200)
    longer = f"{int(time.time()) + 10**6}.{make_token(SECRET, 1.0).partition('.')[2]}"
    for path in ("/v1/memories", "/metrics", "/ready", "/v1/openapi.json", "/nothing"):
        for token, said in (
            ("", "is needed"),
            (other, "not one"),
            (old, "expired"),
            (longer, "not one"),
            ("é", "not one"),
        ):
            status, found = service.get(path, token=token)
            assert (status, found["error"]["status"]) == (401, 401)
            assert said in found["error"]["message"]


@pytest.mark.parametrize(
    ("path", "status", "said"),
    [
        ("/v1/memories/none", 404, "no memory 'none'"),
        ("/v1/memories/one/nearest?id=99", 404, "no instance 99"),
        ("/v1/memories/one/nearest", 400, "a point or an instance"),
        ("/v1/memories/one/nearest?x=1", 400, "three"),
        ("/v1/memories/one/nearest?x=1&y=2&z=inf", 422, "z"),
        ("/v1/find?text=small+mug", 400, "ask the memory file"),
        ("/v1/find?text=" + "mug+" * 400, 422, "500 characters"),
        ("/v1/find?text=mug&limit=100000", 422, "limit"),
        ("/v1/find?text=mug&offset=-1", 422, "offset"),
        ("/v1/relations?predicate=left_of&memory=one", 400, "is not stored"),
    ],
)
def test_what_makes_no_sense_is_explained(service: Service, path: str, status: int, said: str) -> None:
    found = service.get(path)
    assert found[0] == status == found[1]["error"]["status"]
    assert said in found[1]["error"]["message"]
    assert "\n" not in found[1]["error"]["message"]


@pytest.mark.parametrize(
    ("asked", "status", "said"),
    [
        ({"vector": [1.0] * 15}, 400, "15 numbers does not belong to test@1/16"),
        ({"vector": [1.0] * 16, "space": "none@1/16"}, 400, "no vectors of none@1/16"),
        ({"vector": [0.0] * 16}, 400, "not all zero"),
        ({"vector": [float("inf")] * 16}, 400, "finite numbers"),
        ({"vector": [1.0] * 16, "memory": "../../x"}, 404, "no memory"),
    ],
)
def test_vectors_that_cannot_be_compared_are_explained(
    service: Service, asked: dict[str, Any], status: int, said: str
) -> None:
    found = service.get("/v1/similar", method="POST", body={"space": "test@1/16"} | asked)
    assert found[0] == status == found[1]["error"]["status"]
    assert said in found[1]["error"]["message"]


@pytest.mark.parametrize("length", [1e38, 1e-38, 1e300])
def test_how_long_a_vector_is_does_not_matter(service: Service, length: float) -> None:
    vector = [float(n % 3 - 1) for n in range(16)]
    told = [
        service.get("/v1/similar", method="POST", body={"vector": [by * x for x in vector], "space": "test@1/16"})
        for by in (1.0, length)
    ]
    assert told[0][0] == 200 and told[0][1]["matches"]
    assert told[1] == told[0]


@pytest.mark.parametrize("text", ["x'; DROP TABLE memory; --", "%s%s", "\x00", '") OR 1=1', "../../etc/passwd"])
def test_what_is_asked_is_never_part_of_a_statement(service: Service, text: str) -> None:
    for path in ("/v1/find?text={}", "/v1/memories/{}", "/v1/relations?subject={}", "/v1/find?text=mug&memory={}"):
        status, found = service.get(path.format(quote(text, safe="")))
        assert status in (200, 400, 404)
        assert found["matches"] == []
    assert [m["name"] for m in service.get("/v1/memories")[1]["matches"]] == ["one", "two"]


@pytest.mark.parametrize("told", [True, False])
def test_a_request_of_100_mb_is_refused_before_it_is_read(service: Service, told: bool) -> None:
    with socket.create_connection(("127.0.0.1", service.port), timeout=30) as client:
        length = "Content-Length: 104857600" if told else "Transfer-Encoding: chunked"
        bearer = f"Authorization: Bearer {make_token(SECRET, 1.0)}"
        client.sendall(f"POST /v1/similar HTTP/1.1\r\nHost: a\r\n{bearer}\r\n{length}\r\n\r\n".encode())
        sent, piece = 0, b"x" * 65536
        try:
            while sent < 100 * 2**20:
                client.sendall(piece if told else b"%x\r\n%s\r\n" % (len(piece), piece))
                sent += len(piece)
        except OSError:
            pass
        answer = b""
        try:
            while more := client.recv(65536):
                answer += more
        except ConnectionError:
            pass
    assert sent < 32 * 2**20
    assert answer == b"" or b" 413 " in answer.splitlines()[0]
    assert service.get("/health", token="")[0] == 200


def test_headers_without_end_are_refused(service: Service) -> None:
    with socket.create_connection(("127.0.0.1", service.port), timeout=30) as client:
        client.sendall(b"GET /v1/memories HTTP/1.1\r\n")
        try:
            for n in range(4000):
                client.sendall(b"X-%d: %s\r\n" % (n, b"y" * 200))
            assert b" 400 " in client.recv(100)
        except OSError:
            pass
    assert service.get("/health", token="")[0] == 200


def test_slow_clients_are_let_go(service: Service) -> None:
    """Both have waited since the service began, and end by its limit of time."""
    headers, body = service.slow
    assert headers.recv(1000) == b""
    assert b" 408 " in body.recv(1000).splitlines()[0]


ANSWERED = f"GET /v1/memories HTTP/1.1\r\nHost: a\r\nAuthorization: Bearer {make_token(SECRET, 1.0)}\r\n\r\n"
WAITING, BODY = "GET /health HTTP/1.1\r\nHos", "GET /health HTTP/1.1\r\nHost: a\r\nContent-Length: 9\r\n\r\n{"
"""Without the end of the headers, and of the body."""


def status_of(client: socket.socket) -> int:
    """The status of an answer, which is read whole."""
    answer = http.client.HTTPResponse(client)
    answer.begin()
    answer.read()
    return answer.status


@contextlib.contextmanager
def clients(port: int, count: int, *texts: str) -> Iterator[list[socket.socket]]:
    """Clients that have sent each of some texts, the next one when the one before was answered."""
    with contextlib.ExitStack() as held:
        found = []
        for _ in range(count):
            client = held.enter_context(socket.create_connection(("127.0.0.1", port), timeout=30))
            for n, text in enumerate(texts):
                if n:
                    assert status_of(client) == 200
                client.sendall(text.encode())
            found.append(client)
        yield found


def test_without_a_token_a_connection_has_one_request(service: Service) -> None:
    with clients(service.port, 1, f"{WAITING}t: a\r\n\r\n" * 2) as (client,):
        assert status_of(client) == 200
        assert client.recv(1000) == b""


def test_every_request_of_a_connection_has_its_limit_of_time(service: Service) -> None:
    with clients(service.port, 20, ANSWERED, WAITING) as half, clients(service.port, 20, ANSWERED, ANSWERED) as idle:
        assert {status_of(client) for client in idle} == {200}
        assert {client.recv(1000) for client in (*half, *idle)} == {b""}


@pytest.mark.slow
@pytest.mark.parametrize("texts", [(), (ANSWERED, WAITING), (WAITING,), (BODY,)])
def test_slow_clients_make_room_for_others(service: Service, texts: tuple[str, ...]) -> None:
    """Those of the same address, too, and those first that have waited longest."""
    with clients(service.port, 300, *texts) as slow:
        assert {service.get("/v1/find?text=mug")[0] for _ in range(20)} == {200}
        with contextlib.suppress(ConnectionResetError):
            assert slow[0].recv(1000) == b""
        slow[-1].settimeout(0.1)
        with pytest.raises(TimeoutError):
            slow[-1].recv(1000)


def test_a_client_that_takes_no_answers_is_let_go(service: Service) -> None:
    with socket.socket() as client, pytest.raises(ConnectionError):
        client.settimeout(60)
        client.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        client.connect(("127.0.0.1", service.port))
        while True:  # until the service takes no more, and then ends the connection
            client.sendall(ANSWERED.replace("memories", "openapi.json").encode() * 1000)
    assert service.get("/health", token="")[0] == 200


def test_what_is_being_answered_keeps_its_place(tmp_path: Path) -> None:
    """Two requests wait for the database, which are as many as may: others are told so, and cost them nothing."""
    uvicorn = pytest.importorskip("uvicorn", reason="uvicorn is not installed: pip install '.[serve]'")
    from list3r.server.http.app import make_service
    from list3r.server.http.limits import ServiceLimits
    from list3r.server.http.running import server_config

    limits = ServiceLimits(request_s=60.0, at_once=2, open_at_once=8, of_one_address=4)
    with Catalog.open(str(tmp_path / "catalog.sqlite")) as catalog, socket.create_server(("127.0.0.1", 0)) as listener:
        port = listener.getsockname()[1]
        server = uvicorn.Server(server_config(make_service(catalog, SECRET, limits), limits))
        running = threading.Thread(target=server.run, kwargs={"sockets": [listener]})
        running.start()
        try:
            with contextlib.ExitStack() as held:
                with catalog._backend._turn:  # type: ignore[attr-defined]
                    early = held.enter_context(clients(port, 2, ANSWERED))
                    (late,) = held.enter_context(clients(port, 1, ANSWERED))
                    assert status_of(late) == 503
                    waiting = held.enter_context(clients(port, 20, WAITING))
                    assert waiting[0].recv(1000) == b""
                assert {status_of(client) for client in early} == {200}
        finally:
            server.should_exit = True
            running.join()


def test_health_and_counts(service: Service) -> None:
    assert service.get("/ready") == (200, {"status": "ok"})
    counts = service.get("/metrics")[1]
    assert 'path="/v1/memories/{name}/nearest",status="404"} 1\n' in counts
    assert 'path="other",status="401"}' in counts
    assert "none" not in counts
    paths = service.get("/v1/openapi.json")[1]["paths"]
    assert {"/v1/find", "/v1/memories/{name}/nearest", "/v1/relations", "/health"} <= paths.keys()


def test_an_interrupt_ends_the_service(service: Service) -> None:
    service.process.send_signal(signal.SIGINT)
    assert service.process.wait(timeout=30) in (0, 1, 130, -signal.SIGINT)
    assert service.process.stderr is not None
    assert "Traceback" not in service.process.stderr.read()


def test_tokens_need_a_secret_and_an_end() -> None:
    token = make_token(SECRET, 2.0, now_s=1000.0)
    assert refusal(SECRET, token, now_s=8199.0) is None
    assert refusal(SECRET, token, now_s=8201.0) == "the token has expired; ask for a new one"
    for secret, hours in (("short", 1.0), (SECRET, 0.0), (SECRET, 1e9), (SECRET, float("nan"))):
        with pytest.raises(OptionError):
            make_token(secret, hours)


def test_a_service_without_a_catalogue_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("fastapi")
    from list3r.cli.app import run

    (tmp_path / "no.sqlite").write_bytes(b"something else that is no catalogue at all" * 40)
    assert run(["serve", "--catalog", str(tmp_path / "no.sqlite"), "--port", "0"]) == 2
    assert run(["serve", "--workers", "0"]) == 2
    monkeypatch.delenv("LIST3R_SERVE_SECRET", raising=False)
    assert run(["serve", "--token-for", "1"]) == 2
