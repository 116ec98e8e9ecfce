"""The report page of an identification."""
