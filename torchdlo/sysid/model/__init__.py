"""The simulated rope of a recording: discretisation, gripper motion, initial state, observation."""
