"""Speed beside accuracy: `make bench`. Figures in the README come from here."""
