export { AmbientLight, AxesHelper, BufferAttribute, BufferGeometry, BoxGeometry, CanvasTexture, Color, ConeGeometry, DirectionalLight, GridHelper, Group, Line, LineBasicMaterial, LineSegments, Matrix4, Mesh, MeshBasicMaterial, MeshLambertMaterial, NearestFilter, PerspectiveCamera, PlaneGeometry, Points, Quaternion, Scene, ShaderMaterial, SphereGeometry, TOUCH, Vector3, WebGLRenderer } from 'three';
export { OrbitControls } from 'three/examples/jsm/controls/OrbitControls.js';
export { default as URDFLoader } from 'urdf-loader';
