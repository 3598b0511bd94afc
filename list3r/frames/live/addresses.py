"""Which sources are live, by their names."""

from __future__ import annotations

from urllib.parse import urlsplit, urlunsplit

SCHEMES = ("rtsp", "rtsps", "http", "https", "rtmp", "udp", "tcp", "srt")
DEVICES = "/dev/video"
PHONE = "record3d"


def is_stream(source: str) -> bool:
    """Return whether a source is a webcam, the address of a stream, or a phone."""
    return source.startswith(DEVICES) or _scheme(source) in (*SCHEMES, PHONE)


def is_phone(source: str) -> bool:
    """Return whether a source is a phone."""
    return _scheme(source) == PHONE


def without_secrets(source: str) -> str:
    """Return the address without name, password, query and serial number, as it may be shown and stored."""
    if is_phone(source):
        return f"{PHONE}://usb"
    if _scheme(source) not in SCHEMES:
        return source
    parts = urlsplit(source)
    return urlunsplit((parts.scheme, parts.netloc.rpartition("@")[2], parts.path, "", ""))


def _scheme(source: str) -> str:
    try:
        return urlsplit(source).scheme.lower()
    except ValueError:  # brackets that are no address
        return ""
