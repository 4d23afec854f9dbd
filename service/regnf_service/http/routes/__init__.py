"""The routes, a module a resource. A new module enters one of the two lists below; nothing else needs to know it."""

from regnf_service.http.routes import (
    batches,
    demo,
    fields,
    jobs,
    library,
    meta,
    pages,
    recordings,
    registrations,
    renderings,
    results,
    uploads,
)

ROUTERS = (
    uploads.router,
    fields.router,
    recordings.router,
    library.router,
    registrations.router,
    renderings.router,
    batches.router,
    jobs.router,
    results.router,
    demo.router,
)
"""Query parameters that an address does not know are refused."""
LENIENT_ROUTERS = (pages.router, meta.router)
"""Such parameters are ignored: people and probes add them to links."""
