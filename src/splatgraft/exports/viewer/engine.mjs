// The parts of the PlayCanvas engine that viewer.js uses; see README.md.
export {
  AppBase, AppOptions, Asset, CameraComponentSystem, Color, ContainerHandler, Entity, GSplatComponentSystem,
  GSplatHandler, Quat, TextureHandler, Vec3, WebglGraphicsDevice,
} from "playcanvas";
