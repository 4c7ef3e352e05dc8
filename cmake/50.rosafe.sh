# Sourced by catkin's setup.sh: puts the package genomix on the paths of tclsh, Octave and MATLAB. TCLLIBPATH is a Tcl list.
# shellcheck shell=sh
case " ${TCLLIBPATH:-} " in
  *" $CATKIN_ENV_HOOK_WORKSPACE/lib/tcltk "*) ;;
  *) export TCLLIBPATH="$CATKIN_ENV_HOOK_WORKSPACE/lib/tcltk${TCLLIBPATH:+ $TCLLIBPATH}" ;;
esac
case ":${OCTAVE_PATH:-}:" in
  *":$CATKIN_ENV_HOOK_WORKSPACE/lib/matlab:"*) ;;
  *) export OCTAVE_PATH="$CATKIN_ENV_HOOK_WORKSPACE/lib/matlab${OCTAVE_PATH:+:$OCTAVE_PATH}" ;;
esac
case ":${MATLABPATH:-}:" in
  *":$CATKIN_ENV_HOOK_WORKSPACE/lib/matlab:"*) ;;
  *) export MATLABPATH="$CATKIN_ENV_HOOK_WORKSPACE/lib/matlab${MATLABPATH:+:$MATLABPATH}" ;;
esac
