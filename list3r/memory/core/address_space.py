"""Whether the limits of the process leave its libraries room; where they do not, these crash or wait for ever."""

from __future__ import annotations

from list3r.memory.core.errors import OptionError

BUILD_MB = 1536
"""MiB of address space that a process which builds takes, of which a tenth is ever used."""
USD_MB = 2048
"""The same of OpenUSD."""


def check_address_space(least_mb: int, what: str) -> None:
    """Raise `OptionError` where this process may not have so much address space (`ulimit -v`)."""
    try:
        import resource
    except ImportError:  # a system without such limits
        return
    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    if limit != resource.RLIM_INFINITY and limit < least_mb * 2**20:
        raise OptionError(
            f"the address space of this process is limited to {limit >> 20} MiB (ulimit -v), and {what} takes "
            f"{least_mb}: raise it, or limit the memory in use instead, as containers do"
        )
