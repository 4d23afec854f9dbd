"""Uploads of fields: bytes to the storage, a record, an import job."""
