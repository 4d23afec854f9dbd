"""The HTTP front end of regnf: contract, routes, job and field records, blob storage, queue client, web page.

Nothing in this package imports torch, open3d or ``worker``.
"""
