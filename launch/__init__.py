"""Commands that a person runs: arguments in, one call, words out. See README.md."""
