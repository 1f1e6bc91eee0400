#!/bin/sh
# lock.sh: write the *.txt locks (every version and hash, for Python 3.11 to 3.13) from the *.in lists.
set -eu
cd "$(dirname "$0")/.."
compile() {
    UV_PYTHON_DOWNLOADS=never uv pip compile --quiet --universal --python-version 3.11 --fork-strategy fewest \
        --generate-hashes --no-annotate --no-emit-index-url --custom-compile-command requirements/lock.sh "$@"
}
compile requirements/runtime.in --output-file requirements/runtime.txt
compile requirements/development.in --constraints requirements/runtime.txt --output-file requirements/development.txt
compile requirements/benchmark.in --constraints requirements/development.txt --output-file requirements/benchmark.txt
