"""The one exception for misuse."""


class InputError(ValueError):
    """Raised for every misuse: names vertex, face, file or argument, the reason, the next move."""
