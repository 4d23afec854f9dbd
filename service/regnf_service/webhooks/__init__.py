"""Telling callers that their jobs have ended: signed messages to addresses on an allow-list (Standard Webhooks 1.0)."""
