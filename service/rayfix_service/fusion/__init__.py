"""Pure numerics: a report and a table in, a posterior out. Knows nothing of the web."""
