"""Webhooks: which hosts and addresses they may go to."""

from __future__ import annotations

import base64
import ipaddress

import pytest

from regnf_service.tokens import TokensError
from regnf_service.webhooks.targets import AllowList, is_public, read_secrets, signed_headers
from tests.service.conftest import KEY, SECRET, hmac_by_hand


@pytest.mark.parametrize(
    ("url", "allowed"),
    [
        ("https://hooks.example.org/a?b=c", True), ("https://HOOKS.example.org.:443/", True),
        ("http://hooks.example.org/", False), ("https://hooks.example.org:8443/", False),
        ("https://evil.example.org/", False), ("https://hooks.example.org.evil.org/", False),
        ("https://hooks.example.org@evil.org/", False), ("https://user@hooks.example.org/", False),
        ("https://hooks.example.org/#part", False), ("https://evil.org\\@hooks.example.org/", False),
        ("https://hooks.example.org/\r\nX: y", False), ("https://hooks.example.org:99999/", False),
        ("https://hooks.example.org/" + "a" * 2000, False), ("ftp://hooks.example.org/", False),
        ("//hooks.example.org/", False), ("http://127.0.0.1:9000/x", True), ("http://127.1:9000/x", False),
        ("http://[::ffff:127.0.0.1]:9000/x", True), ("https://127.0.0.1:9000/x", False), ("https://[::1", False),
    ],
)  # fmt: skip
def test_only_hosts_on_the_list(url: str, allowed: bool) -> None:
    assert AllowList(["hooks.example.org", "http://127.0.0.1:9000"]).allows(url) is allowed


@pytest.mark.parametrize("entry", ["", "a b", "ftp://x", "https://x/path", "user@x", "x:notaport"])
def test_entries_that_are_no_hosts(entry: str) -> None:
    with pytest.raises(TokensError):
        AllowList([entry])


PRIVATE = ["127.0.0.1", "10.1.2.3", "172.16.0.1", "192.168.0.1", "169.254.169.254", "0.0.0.0", "100.64.0.1",
           "224.0.0.1", "255.255.255.255", "::1", "::", "fe80::1%eth0", "fc00::1", "::ffff:10.0.0.1", "64:ff9b::a00:1",
           "2002:a00:1::1", "ff02::1", "64:ff9b:1::a00:1", "fec0::1", "::127.0.0.1", "::a00:1", "5f00::1", "3fff::1",
           "2001::1", "2001:db8::1", "100::1", "4000::1", "::ffff:0:7f00:1", "240.0.0.1", "198.18.0.1"]  # fmt: skip


SPECIAL_V4 = ["0.0.0.0/8", "10.0.0.0/8", "100.64.0.0/10", "127.0.0.0/8", "169.254.0.0/16", "172.16.0.0/12",
              "192.0.0.0/24", "192.0.2.0/24", "192.31.196.0/24", "192.52.193.0/24", "192.88.99.0/24", "192.168.0.0/16",
              "192.175.48.0/24", "198.18.0.0/15", "198.51.100.0/24", "203.0.113.0/24", "224.0.0.0/4",
              "240.0.0.0/4"]  # fmt: skip
SPECIAL_V6 = ["::/96", "::ffff:0:0:0/96", "64:ff9b::/96", "64:ff9b:1::/48", "100::/64", "100:0:0:1::/64", "2001::/23",
              "2001:db8::/32", "2002::/16", "2620:4f:8000::/48", "3fff::/20", "5f00::/16", "fc00::/7", "fe80::/10",
              "fec0::/10", "ff00::/8"]  # fmt: skip
PUBLIC = ["1.1.1.1", "9.255.255.255", "11.0.0.1", "93.184.215.14", "100.63.255.255", "100.128.0.1", "192.0.1.1",
          "192.88.98.255", "192.88.100.1", "198.17.255.255", "223.255.255.255", "2001:200::1",
          "2606:2800:21f:cb07:6820:80da:af6b:8b2c", "2001:4860:4860::8888", "2003::1", "::ffff:1.1.1.1"]  # fmt: skip


def test_addresses_that_are_public_and_that_are_not() -> None:
    assert [address for address in PRIVATE if is_public(address)] == []
    assert [address for address in PUBLIC if not is_public(address)] == []


@pytest.mark.parametrize("network", SPECIAL_V4 + SPECIAL_V6)
def test_networks_for_special_purposes_are_not_public(network: str) -> None:
    """The registries of IANA, multicast and what nobody has been given; first, last and others of each."""
    held = ipaddress.ip_network(network)
    step = max(1, held.num_addresses // 97)
    for place in {*range(0, held.num_addresses, step), held.num_addresses - 1, 8 % held.num_addresses}:
        assert not is_public(str(held[place]))
        if held.version == 4:
            assert not is_public(f"::ffff:{held[place]}"), "nor as an IPv4 address within IPv6"


# how webhooks are signed, and which secrets are refused


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
