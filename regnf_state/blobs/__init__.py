"""The blob store: a folder or an object store."""
