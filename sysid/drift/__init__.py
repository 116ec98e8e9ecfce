"""Whether a stored result still holds of later logs."""
