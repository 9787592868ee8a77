"""What a kind of problem raises where a scene and recordings are none of it."""


class DoesNotFit(ValueError):
    """A scene and recordings that a class of problem or windows is not for: something
    else moves, a channel is missing, there is too little of it. Then another class is
    tried; any other error is a defect, or bad input, and is let through."""
