"""How webhooks are signed, and which secrets are refused."""

from __future__ import annotations

import base64

import pytest

from regnf_service.tokens import TokensError
from regnf_service.webhooks.targets import read_secrets, signed_headers
from tests.service.webhook_receiver import KEY, SECRET, hmac_by_hand


def test_the_signature_is_that_of_the_specification() -> None:
    body = b'{"event_type":"ping","data":{"success":true}}'
    headers = signed_headers([KEY, b"k" * 64], "msg_1", 1731705121, body)
    expected = [hmac_by_hand(key, b"msg_1.1731705121." + body) for key in (KEY, b"k" * 64)]
    assert [base64.b64decode(one.removeprefix("v1,")) for one in headers["webhook-signature"].split(" ")] == expected
    assert (headers["webhook-id"], headers["webhook-timestamp"]) == ("msg_1", "1731705121")


NO_SECRETS = ["", SECRET, "alice:", "alice:whsec_", "alice:whsec_AAAA", f"Alice:{SECRET}", f"alice:{SECRET}!",
              "alice:whsec_" + "A" * 92, "alice:" + SECRET[6:]]  # fmt: skip


@pytest.mark.parametrize("entry", NO_SECRETS)
def test_secrets_that_are_none_are_refused_without_repeating_them(entry: str) -> None:
    with pytest.raises(TokensError) as refused:
        read_secrets([entry])
    assert SECRET[6:] not in str(refused.value)
