# Sourced by catkin's setup.sh: lets tclsh find the package genomix. TCLLIBPATH is a Tcl list.
# shellcheck shell=sh
case " ${TCLLIBPATH:-} " in
  *" $CATKIN_ENV_HOOK_WORKSPACE/lib/tcltk "*) ;;
  *) export TCLLIBPATH="$CATKIN_ENV_HOOK_WORKSPACE/lib/tcltk${TCLLIBPATH:+ $TCLLIBPATH}" ;;
esac
