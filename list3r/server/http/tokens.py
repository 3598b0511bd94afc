"""Tokens that say until when they hold, signed with the secret of a service: no state, any process can check them."""

from __future__ import annotations

import hashlib
import hmac
import time

from list3r.memory.core.errors import OptionError

SHORTEST_SECRET = 16
"""Characters of a secret, at least."""


def make_token(secret: str, hours: float, now_s: float | None = None) -> str:
    """Return a token that holds for some hours. Raises `OptionError` for a weak secret."""
    if len(secret) < SHORTEST_SECRET:
        raise OptionError(f"the secret is too short to be safe; give at least {SHORTEST_SECRET} characters")
    if not 0 < hours <= 24 * 366:
        raise OptionError(f"a token for {hours:g} hours: it must be valid for more than 0 hours and at most a year")
    until = int((time.time() if now_s is None else now_s) + hours * 3600)
    return f"{until}.{_signature(secret, until)}"


def refusal(secret: str, token: str | None, now_s: float | None = None) -> str | None:
    """Return why a token does not hold, None for one that does."""
    if not token:
        return "a token is needed: send the header Authorization: Bearer TOKEN"
    until, _, signature = token.partition(".")
    known = until.isascii() and until.isdigit() and len(until) < 16
    if not known or not hmac.compare_digest(signature.encode(), _signature(secret, int(until)).encode()):
        return "the token is not one of this service"
    if int(until) < (time.time() if now_s is None else now_s):
        return "the token has expired; ask for a new one"
    return None


def _signature(secret: str, until: int) -> str:
    return hmac.new(secret.encode(), f"list3r {until}".encode(), hashlib.sha256).hexdigest()
