# Sourced by the other bash scripts of this folder: sets `root` to the checkout, and ends if its path cannot be used.
# shellcheck shell=bash

root=$(realpath "$0")
root=${root%/scripts/*}
case $root in
  *[:$'\n']*)
    printf '%s: checkout: expected a path without : and line breaks, which separate folders in PATH and PYTHONPATH, got %q; rename or move it\n' \
      "scripts/${0##*/}" "$root" >&2
    exit 1
    ;;
esac
