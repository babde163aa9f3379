"""The valve engine; started by the companion, with the socket to speak through."""

import sys

from companion.output.engine.process import main

sys.exit(main(sys.argv[1:]))
