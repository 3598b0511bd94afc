"""Connections to a phone over USB, through usbmuxd (Linux, macOS) or the service of Apple's drivers (Windows).

Messages are property lists behind four little-endian numbers: length, version 1, kind 8, tag. After `Connect` the
socket is that of the phone's port. `USBMUXD_SOCKET_ADDRESS` (UNIX:PATH or HOST:PORT) names another daemon, as it does
for libusbmuxd.
"""

from __future__ import annotations

import os
import plistlib
import socket
import struct
import sys
from typing import Any
from xml.parsers.expat import ExpatError

from list3r import __version__
from list3r.frames.live.camera import LostError
from list3r.memory.core.errors import SourceError

ADDRESS = "USBMUXD_SOCKET_ADDRESS"
_USUAL = "127.0.0.1:27015" if sys.platform == "win32" else "UNIX:/var/run/usbmuxd"
_HEADER = struct.Struct("<4I")
_VERSION, _PLIST = 1, 8
_REFUSED = 3
_MOST_BYTES = 1 << 20


def connect(serial: str, port: int, timeout_s: float) -> socket.socket:
    """Connect to a port of the phone with a serial number, or of the only one where none is named.

    Raises `LostError`, and `SourceError` where several phones are connected.
    """
    daemon = _daemon(timeout_s)
    try:
        phones = [d for d in _ask(daemon, "ListDevices").get("DeviceList", ()) if _by_usb(d)]
        found = [d for d in phones if serial in ("", _serial(d))]
        if not found:
            raise LostError("no iPhone is connected" if not phones else f"no iPhone {serial} is connected")
        if len(found) > 1:
            names = ", ".join(f"record3d:{_serial(d)}" for d in found)
            raise SourceError(f"{len(found)} iPhones are connected; name one: {names}")
        swapped = int.from_bytes(port.to_bytes(2, "little"), "big")
        number = _ask(daemon, "Connect", DeviceID=found[0]["DeviceID"], PortNumber=swapped).get("Number")
        if number == _REFUSED:
            raise LostError("the phone does not stream: in Record3D choose USB streaming and press the red button")
        if number != 0:
            raise LostError(
                f"usbmuxd does not connect to the phone (result {number}): unlock it and trust this computer"
            )
        return daemon
    except BaseException:
        daemon.close()
        raise


def receive(connection: socket.socket, count: int) -> bytearray:
    """Return this many bytes. Raises `LostError`."""
    data = bytearray(count)
    view, held = memoryview(data), 0
    try:
        while held < count:
            more = connection.recv_into(view[held:])
            if more == 0:
                raise LostError("it was closed")
            held += more
    except TimeoutError:
        raise LostError("no data came") from None
    except OSError as error:
        raise LostError(error.strerror or str(error)) from None
    return data


def _daemon(timeout_s: float) -> socket.socket:
    address = os.environ.get(ADDRESS) or _USUAL
    kind, _, rest = address.partition(":")
    try:
        if kind.upper() == "UNIX":
            daemon = socket.socket(socket.AF_UNIX)
            daemon.settimeout(timeout_s)
            daemon.connect(rest)
            return daemon
        host, _, port = address.rpartition(":")
        return socket.create_connection((host, int(port)), timeout_s)
    except (OSError, ValueError, OverflowError) as error:
        reason = getattr(error, "strerror", None) or error
        raise LostError(f"usbmuxd does not answer at {address} ({reason}): is it installed and running?") from None


def _ask(daemon: socket.socket, kind: str, **words: object) -> dict[str, Any]:
    """Return the answer to a message. Raises `LostError`."""
    message = {"MessageType": kind, "ProgName": "list3r", "ClientVersionString": f"list3r {__version__}", **words}
    body = plistlib.dumps({**message, "kLibUSBMuxVersion": 3})
    try:
        daemon.sendall(_HEADER.pack(_HEADER.size + len(body), _VERSION, _PLIST, 1) + body)
    except OSError as error:
        raise LostError(f"usbmuxd: {error.strerror or error}") from None
    length = _HEADER.unpack(receive(daemon, _HEADER.size))[0] - _HEADER.size
    if not 0 < length <= _MOST_BYTES:
        raise LostError("usbmuxd answers in another protocol; is it older than 1.1?")
    try:
        answer = plistlib.loads(bytes(receive(daemon, length)))
    except (plistlib.InvalidFileException, ExpatError, ValueError):
        answer = None
    if not isinstance(answer, dict):
        raise LostError("usbmuxd answers in another protocol; is it older than 1.1?")
    return answer


def _by_usb(device: Any) -> bool:
    known = isinstance(device, dict) and isinstance(device.get("DeviceID"), int)
    return known and device.get("Properties", {}).get("ConnectionType", "USB") == "USB"


def _serial(device: Any) -> str:
    return str(device.get("Properties", {}).get("SerialNumber", ""))
