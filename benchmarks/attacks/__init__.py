"""Attacks on a running service, drawn at random from grammars: each run says what held and what did not."""
