"""The report of an evaluation: tables, maps, pictures of beliefs, the page."""
