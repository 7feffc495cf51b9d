"""What the studies share: how one is run, its scenes and methods, and what is imagined, judged and measured."""
