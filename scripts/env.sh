# Sourced by bash, dash or zsh (`. scripts/env.sh`): puts the executables, the Python and Tcl packages and the ROS
# packages of this checkout on the paths, and generates the messages if they are missing or outdated. Sets ROS_MASTER_URI
# and ROS_IP to loopback if they are unset. A second call has no further effect.
# shellcheck shell=sh

_rosafe_file=
if [ -n "${BASH_VERSION:-}" ]; then
  # shellcheck disable=SC2016  # only bash evaluates it
  eval '_rosafe_file=${BASH_SOURCE[0]}'
elif [ -n "${ZSH_VERSION:-}" ]; then
  # shellcheck disable=SC2016
  eval '_rosafe_file=${(%):-%x}'
  [ -e "$_rosafe_file" ] || _rosafe_file=$0 # %x shows a line break as \n
else
  # dash has no variable with the name of a sourced file, but it has the file open. The process id comes from a child's
  # $PPID, since $$ in a subshell is not the id of the subshell.
  # shellcheck disable=SC2016
  for _rosafe_link in "/proc/$(/bin/sh -c 'echo $PPID')/fd/"*; do
    if _rosafe_target=$(readlink "$_rosafe_link"); then
      case $_rosafe_target in */scripts/env.sh) _rosafe_file=$_rosafe_target ;; esac
    fi
  done
  if [ -z "$_rosafe_file" ]; then # no /proc: search the working directory and its parents
    _rosafe_file=$PWD
    until [ -z "$_rosafe_file" ] || [ -f "$_rosafe_file/scripts/env.sh" ]; do _rosafe_file=${_rosafe_file%/*}; done
    _rosafe_file=$_rosafe_file/scripts/env.sh
  fi
fi

_rosafe_status=1
_rosafe_root=$(realpath -- "$_rosafe_file" 2>/dev/null) || :
_rosafe_root=${_rosafe_root%/scripts/env.sh}
_rosafe_path=$(printf '%s' "$_rosafe_root" | tr '\n' ':')
if [ "$_rosafe_path" != "${_rosafe_path%%:*}" ]; then
  echo "rosafe: checkout: expected a path without : and line breaks, which separate folders in PATH and PYTHONPATH, got $_rosafe_path; rename or move it" >&2
elif [ ! -f "$_rosafe_root/rosafe/ros1/component/generate.py" ]; then
  echo "rosafe: the folder of env.sh cannot be determined in this shell; change into the checkout, then: . scripts/env.sh" >&2
elif [ ! -x /usr/bin/python3 ]; then
  echo "rosafe: /usr/bin/python3 is missing; run $_rosafe_root/scripts/install" >&2
elif _rosafe_exports=$(PYTHONPATH="$_rosafe_root${PYTHONPATH:+:$PYTHONPATH}" \
  /usr/bin/python3 -P -m rosafe.ros1.component.generate --shell); then
  eval "$_rosafe_exports"
  _rosafe_status=0
fi

unset _rosafe_file _rosafe_link _rosafe_target _rosafe_root _rosafe_path _rosafe_exports
if [ "$_rosafe_status" = 1 ]; then
  unset _rosafe_status
  return 1
fi
unset _rosafe_status
