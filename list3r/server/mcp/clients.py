"""The entries with which common programs start or reach the server of a memory."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from list3r.memory.core.errors import check_choice

CLIENTS = {
    "claude": ("mcpServers", "claude_desktop_config.json, or .mcp.json of a project"),
    "cursor": ("mcpServers", ".cursor/mcp.json"),
    "gemini": ("mcpServers", ".gemini/settings.json"),
    "vscode": ("servers", ".vscode/mcp.json"),
    "codex": ("mcp_servers", ".codex/config.toml"),
}
"""Name of the table of servers, and the file that it stands in."""


def config_entry(memory: Path, client: str, *, write: bool = False) -> tuple[str, str]:
    """Return the file that a program reads and the text to put into it. Raises `OptionError` for an unknown one."""
    check_choice("client", client, CLIENTS)
    table, file = CLIENTS[client]
    name = f"list3r-{memory.stem}"
    arguments = ["-m", "list3r", "mcp", str(memory.resolve()), *(["--write"] if write else [])]
    if client == "codex":
        lines = [
            f"[{table}.{json.dumps(name)}]",
            f"command = {json.dumps(sys.executable)}",
            f"args = {json.dumps(arguments)}",
        ]
        return file, "\n".join(lines)
    entry: dict[str, Any] = {"command": sys.executable, "args": arguments}
    if client == "vscode":
        entry = {"type": "stdio", **entry}
    return file, json.dumps({table: {name: entry}}, indent=2)
