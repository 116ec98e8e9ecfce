"""The one error that all readers of captures raise."""


class CaptureError(ValueError):
  """An input that cannot become a capture; the message is one line a person can act on."""
