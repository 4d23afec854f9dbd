"""What the tests of the service's parts share."""

from __future__ import annotations

from tests.service.webhook_receiver import receiver

__all__ = ["receiver"]
