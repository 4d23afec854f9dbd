"""Why a service or a worker could not be started."""

from __future__ import annotations

from regnf_core.errors import RegnfError


class StartError(RegnfError):
    """Reasons: STATE_DIR_IN_USE, STATE_DIR_UNUSABLE, ADDRESS_UNAVAILABLE, UNAUTHENTICATED_PUBLIC_BIND,
    TOKENS_UNUSABLE, EMBEDDED_REDIS_MISSING, SERVICE_START_FAILED, REDIS_URL_MISSING, REDIS_UNAVAILABLE,
    STORAGE_MISMATCH."""

    unavailable = True
    reason = "SERVICE_START_FAILED"
