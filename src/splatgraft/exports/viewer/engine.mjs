// The parts of the PlayCanvas engine that viewer.js uses; see README.md.
export {
  AppBase, AppOptions, Asset, CameraComponentSystem, Color, ContainerHandler, Entity, GSplatComponentSystem,
  GSplatHandler, Layer, PIXELFORMAT_RGBA16F, Quat, RenderTarget, Texture, TextureHandler, Vec3, Vec4,
  WebglGraphicsDevice,
} from "playcanvas";
