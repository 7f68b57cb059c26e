"""Speed side by side: this library against its peers, a textbook step, and the machine's floor; ``make bench``."""
