"""The colours of all figures, without matplotlib.

They are those of Okabe and Ito, which colour-blind readers can tell apart.
"""

BLUE, ORANGE, GREY, RED = "#0072B2", "#E69F00", "#777777", "#C8102E"
PURPLE, GREEN = "#CC79A7", "#009E73"
SKY, VERMILION = "#56B4E9", "#D55E00"
# Colours of individually distinguished series; neighbours differ most.
SERIES = (BLUE, VERMILION, GREEN, PURPLE, SKY, "black", ORANGE)
