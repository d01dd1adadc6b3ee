"""Work of the command attnwarp edit that no method needs: marks, the fit before, and the page."""
