"""The journal in the storage, from which a lost Redis is rebuilt."""
