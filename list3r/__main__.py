"""`python -m list3r` is the command line."""

from list3r.cli import main

if __name__ == "__main__":
    main()
