"""Speed side by side: this library against its peers and a textbook step; ``make bench``."""
