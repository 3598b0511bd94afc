"""A PostgreSQL server of a test's own, from the distribution's package, reached by a socket in a folder of its own.

`LIST3R_POSTGRES_BIN` names the folder of `initdb` and `pg_ctl` where they are not in a usual place.
"""

from __future__ import annotations

import contextlib
import os
import pwd
import shutil
import signal
import socket
import subprocess
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest


def postgres_programs() -> Path:
    """The folder of the server's programs; the test is skipped where there is none."""
    told = os.environ.get("LIST3R_POSTGRES_BIN")
    found = [Path(told)] if told else sorted(Path("/usr/lib/postgresql").glob("*/bin"), reverse=True)
    path = shutil.which("initdb")
    found += [Path(path).parent] if path else []
    for folder in found:
        if (folder / "initdb").exists() and (folder / "pg_ctl").exists():
            return folder
    pytest.skip("no PostgreSQL server is installed (apt-get install postgresql)")


class PostgresServer:
    """A server that is running; `url` names its database of the catalogue."""

    def __init__(self, programs: Path, folder: Path, user: str | None, options: str = "") -> None:
        self._programs, self.folder, self._user, self._options = programs, folder, user, options
        name = user or pwd.getpwuid(os.getuid()).pw_name
        self.url = f"postgresql://{name}@/postgres?host={folder}"
        self._run("initdb", "-D", str(folder / "data"), "-A", "trust", "-E", "UTF8", "--no-sync", "--no-instructions")
        self.start()

    def start(self) -> None:
        """Start it, and wait until it answers."""
        options = f"-c listen_addresses= -c unix_socket_directories={self.folder} -c shared_buffers=256MB"
        options = f"{options} {self._options}"
        log = str(self.folder / "log")
        self._run("pg_ctl", "-D", str(self.folder / "data"), "-l", log, "-w", "-o", options, "start")

    def stop(self) -> None:
        """Stop it in order."""
        self._run("pg_ctl", "-D", str(self.folder / "data"), "-m", "fast", "-w", "stop")

    def kill(self) -> None:
        """End it as a crash does."""
        pid = int((self.folder / "data" / "postmaster.pid").read_text().splitlines()[0])
        os.kill(pid, signal.SIGKILL)
        with contextlib.suppress(subprocess.CalledProcessError):
            self._run("pg_ctl", "-D", str(self.folder / "data"), "-m", "immediate", "-w", "stop")
        (self.folder / "data" / "postmaster.pid").unlink(missing_ok=True)

    def _run(self, program: str, *words: str) -> None:
        command = [str(self._programs / program), *words]
        subprocess.run(
            command, check=True, user=self._user, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, cwd=self.folder
        )


@contextlib.contextmanager
def running_postgres(options: str = "") -> Iterator[PostgresServer]:
    """A fresh server, gone at the end with all that it held. As root it runs under the user of the package.

    `options` are settings of the server, such as "-c port=5433", which go before those of a test.
    """
    programs = postgres_programs()
    user = "postgres" if os.getuid() == 0 else None
    with tempfile.TemporaryDirectory(prefix="list3r-pg-", ignore_cleanup_errors=True) as name:
        folder = Path(name)
        if user is not None:
            os.chown(folder, pwd.getpwnam(user).pw_uid, -1)
        server = PostgresServer(programs, folder, user, options)
        try:
            yield server
        finally:
            with contextlib.suppress(subprocess.CalledProcessError):
                server.stop()


class Network:
    """A way to a server over TCP that can be cut; `url` leads over it."""

    def __init__(self, server: PostgresServer) -> None:
        self._target = str(server.folder / ".s.PGSQL.5432")
        self._pairs: list[socket.socket] = []
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = int(self._listener.getsockname()[1])
        user = server.url.partition("@")[0]
        self.url = f"{user}@127.0.0.1:{self.port}/postgres?sslmode=disable"
        threading.Thread(target=self._accept, args=(self._listener,), daemon=True).start()

    def cut(self) -> None:
        """Let go of all connections, and take no more."""
        for end in (self._listener, *self._pairs):
            with contextlib.suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)
            end.close()
        self._pairs.clear()

    def mend(self) -> None:
        """Take connections again."""
        self._listener = socket.create_server(("127.0.0.1", self.port))
        threading.Thread(target=self._accept, args=(self._listener,), daemon=True).start()

    def _accept(self, listener: socket.socket) -> None:
        with contextlib.suppress(OSError):
            while True:
                client, _ = listener.accept()
                server = socket.socket(socket.AF_UNIX)
                server.connect(self._target)
                self._pairs += [client, server]
                for ends in ((client, server), (server, client)):
                    threading.Thread(target=_passed_on, args=ends, daemon=True).start()


def _passed_on(one: socket.socket, other: socket.socket) -> None:
    with contextlib.suppress(OSError):
        while some := one.recv(65536):
            other.sendall(some)
        other.shutdown(socket.SHUT_WR)
