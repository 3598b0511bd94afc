"""Several memories side by side: a page of this machine that frames the viewer of each."""

from __future__ import annotations

import html
import threading
from collections.abc import Sequence
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

from list3r.viewer.serving import HOST

_PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><title>{title}</title>
<meta http-equiv="Content-Security-Policy"
 content="default-src 'none'; frame-src http://{host}:*; style-src 'unsafe-inline'">
<style>html, body {{ height: 100%; margin: 0; background: #888; }}
body {{ display: grid; gap: 2px; grid-template-columns: repeat({columns}, 1fr); }}
iframe {{ border: 0; width: 100%; height: 100%; background: #fff; }}</style></head>
<body>{frames}</body></html>
"""


def page(viewers: Sequence[tuple[str, str]]) -> str:
    """Return the page that shows viewers, (name, address) each, in up to three columns."""
    frames = "".join(
        f'<iframe title="{html.escape(name)}" src="{html.escape(address)}"></iframe>' for name, address in viewers
    )
    title = html.escape(" | ".join(name for name, _ in viewers))
    return _PAGE.format(title=title, host=HOST, columns=min(len(viewers), 3), frames=frames)


class SideBySide:
    """The server of that page."""

    def __init__(self, viewers: Sequence[tuple[str, str]]) -> None:
        content = page(viewers).encode("utf-8")

        class Handler(BaseHTTPRequestHandler):
            """Answers with the page, whatever is asked for."""

            def do_GET(self) -> None:
                self.send_response(200)
                self.send_header("Content-Type", "text/html; charset=utf-8")
                self.send_header("Content-Length", str(len(content)))
                self.end_headers()
                self.wfile.write(content)

            def log_message(self, format: str, *args: object) -> None:
                """Say nothing: standard error is for people."""

        self._server = ThreadingHTTPServer((HOST, 0), Handler)
        threading.Thread(target=self._server.serve_forever, daemon=True).start()

    @property
    def address(self) -> str:
        """Where the page is."""
        return f"http://{HOST}:{self._server.server_port}"

    def stop(self) -> None:
        """End the server."""
        self._server.shutdown()
        self._server.server_close()
