"""What every answer tells browsers: no other site may read it or show it in a frame, and its type is what it says."""

from __future__ import annotations

from starlette.datastructures import MutableHeaders

_STRICT_POLICY = "default-src 'none'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
_FIXED = {
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
    "X-Frame-Options": "DENY",
}
_UNLESS_SAID = {"Content-Security-Policy": _STRICT_POLICY, "Cache-Control": "no-store"}
"""Pages bring a policy of their own; what may be kept says so itself."""


def secure(headers: MutableHeaders) -> None:
    """Add what is missing."""
    for name, value in _FIXED.items():
        headers[name] = value
    for name, value in _UNLESS_SAID.items():
        headers.setdefault(name, value)


SECURITY_HEADERS = {**_FIXED, **_UNLESS_SAID}
"""For answers that are written without the framework."""
