"""Everything that speaks HTTP: routes, schemas, problems, limits."""
