"""`python -m scopemap`: the same as `scopemap`."""

from scopemap.cli import main

if __name__ == "__main__":
    main()
