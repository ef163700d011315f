// In place of the loaders of meshes, which the page cannot fetch: their files are on the robot, in packages of ROS.
export class STLLoader {}
export class ColladaLoader {}
