// Two clients of one action in one process: both find the server. argv[1] is the action.
#include <cstdio>
#include <actionlib/client/simple_action_client.h>
#include <bass/AcquireAction.h>
#include <ros/ros.h>

typedef actionlib::SimpleActionClient<bass::AcquireAction> Client;

int main(int argc, char **argv) {
  ros::init(argc, argv, "two_clients");
  ros::NodeHandle node;
  Client first(argv[1], true);
  bool found = first.waitForServer(ros::Duration(30.0));
  Client second(argv[1], true);
  bool found_again = second.waitForServer(ros::Duration(30.0));
  std::printf("%d %d", found, found_again);
  if (found_again) {
    bass::AcquireGoal goal;
    goal.device = "file:/nothing.wav";
    second.sendGoal(goal);
    std::printf(" %d", second.waitForResult(ros::Duration(30.0)));
    std::printf(" %d %s", second.getResult()->genom_success, second.getResult()->genom_exdetail.c_str());
  }
  std::printf("\n");
  return 0;
}
