from .regions import Box as Box
