"""Tokens: whose they are, what is refused, and that nothing repeats them."""

from __future__ import annotations

from pathlib import Path

import pytest
from pydantic import ValidationError

from regnf_core.errors import InvalidInputError
from regnf_service.tokens import TokensError, caller_of, read_callers
from regnf_state.ownership import owner_of, reference_of, sha256_of
from regnf_state.settings import Settings, read_settings

SECRET = "s3cret-of-somebody"
SHA = "a" * 64


def test_names_and_tokens(tmp_path: Path) -> None:
    file = tmp_path / "tokens"
    file.write_text("# staff\nbob:two\n  carol-3:three:with:colons  \n\n")
    filed = read_settings(api_tokens=f"@{file}").api_tokens
    callers = read_callers([*filed, "alice:one", "Notaname!:four"])
    known = {"one": "alice", "two": "bob", "three:with:colons": "carol-3"}
    assert {token: caller_of(callers, f"Bearer {token}") for token in known} == known
    nameless = caller_of(callers, "Bearer Notaname!:four")
    # the first digits of the token's SHA-256, by another program
    assert nameless == "token-65e70dd8"
    assert caller_of(callers, "Bearer alice:one") is caller_of(callers, "Basic one") is caller_of(callers, "") is None


@pytest.mark.parametrize("entry", ["", "alice:", f"alice:{SECRET} x", f"alice:{SECRET}\u202e", f"anonymous:{SECRET}"])
def test_what_cannot_be_a_token_is_refused_without_repeating_it(entry: str) -> None:
    with pytest.raises(TokensError) as refused:
        read_callers([entry])
    assert SECRET not in str(refused.value)


def test_a_token_has_one_caller() -> None:
    with pytest.raises(TokensError, match="same token") as refused:
        read_callers([f"alice:{SECRET}", f"bob:{SECRET}"])
    assert SECRET not in str(refused.value)


@pytest.mark.parametrize(("content", "said"), [(None, "cannot be read"), ("", "is empty"), ("# none\n", "no entry")])
def test_a_file_without_secrets_is_refused(tmp_path: Path, content: str | None, said: str) -> None:
    """Without tokens everybody could call: an empty file is no answer to who may."""
    if content is not None:
        (tmp_path / "file").write_text(content)
    for name in ("api_tokens", "webhook_secrets") if content else ("api_tokens", "redis_password", "queue_key"):
        with pytest.raises(InvalidInputError, match=f"REGNF_{name.upper()}: the file .* {said}") as refused:
            read_settings(**{name: f"@{tmp_path / 'file'}"})
        assert refused.value.reason == "INVALID_SETTINGS"


@pytest.mark.parametrize(
    ("variable", "said"),
    [
        ("REGNF_API_TOKENS_FILE", "did you mean REGNF_API_TOKENS=@"),
        ("REGNF_STORAGE_CAP_BYTES", "did you mean REGNF_MAX_STORED_BYTES"),
        ("REGNF_HEARTBEAT_S", "does not exist: the value is fixed"),
    ],
)
def test_variables_of_earlier_versions_are_refused(monkeypatch: pytest.MonkeyPatch, variable: str, said: str) -> None:
    monkeypatch.setenv(variable, "1")
    with pytest.raises(InvalidInputError, match=said) as refused:
        read_settings()
    assert str(refused.value).startswith(variable)


def test_settings_never_repeat_a_secret(monkeypatch: pytest.MonkeyPatch) -> None:
    settings = Settings(api_tokens=frozenset({f"alice:{SECRET}"}), redis_url=f"redis://:{SECRET}@h:1/0")
    assert SECRET not in repr(settings) + str(settings)
    monkeypatch.setenv("REGNF_API_TOKENS", f'[["{SECRET}"]]')
    with pytest.raises(ValidationError) as refused:
        Settings()
    assert SECRET not in str(refused.value)


def test_a_reference_says_whose_it_is() -> None:
    assert reference_of("anonymous", SHA) == SHA
    for caller in ("anonymous", "alice", "a-b-c", "0"):
        reference = reference_of(caller, SHA)
        assert (sha256_of(reference), owner_of(reference)) == (SHA, caller)
        assert all(letter.isalnum() or letter in "_-" for letter in reference)
