"""The HTTP front end of regnf: contract and routes, uploads, submission of jobs, upkeep, webhooks and the web page.

Nothing in this package imports torch, open3d or ``regnf_worker``.
"""
