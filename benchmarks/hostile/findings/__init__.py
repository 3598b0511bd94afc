"""What the attack on version 0.1 found, each as a small script that runs against any checkout of the program."""
