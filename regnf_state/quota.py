"""What each caller may have, as the settings say it."""

from __future__ import annotations

from regnf_state.records import Quota
from regnf_state.settings import Settings


def quota_of(settings: Settings) -> Quota:
    """The quota that holds for every caller."""
    return Quota(
        active_jobs=settings.quota_active_jobs,
        share_jobs=settings.needs_token,
        imports=settings.max_imports_per_caller,
        fields=settings.quota_fields,
        stored_bytes=settings.quota_stored_bytes,
    )
