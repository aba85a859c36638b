"""Where the paper stops: the matcher against each kind of error on its own, and without each of its parts."""
