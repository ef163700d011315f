// Where the robot went by GPS, north up, on a plain grid, or on tiles from the server that the operator named.
const EARTH_M = 6378137;
const RADIANS = Math.PI / 180;
const TILE = 256;
const MOST_TILES = 60;
const DEEPEST = 19;
const LEAST_M = 20; // shown at least

// Web Mercator, in meters of the equator.
const mercator = (lat, lon) => [EARTH_M * lon * RADIANS, EARTH_M * Math.log(Math.tan(Math.PI / 4 + (Math.max(-85, Math.min(85, lat)) * RADIANS) / 2))];
const nice = (meters) => [1, 2, 5, 10].map((step) => step * 10 ** Math.floor(Math.log10(meters))).find((step) => step >= meters);

export class GpsMap {
  constructor(canvas, tiles) {
    this.canvas = canvas;
    this.tiles = tiles;
    this.pictures = new Map();
  }

  draw(ring) {
    const { clientWidth: width, clientHeight: height } = this.canvas.parentElement;
    if (!width || !height) return;
    const ratio = Math.min(devicePixelRatio, 2);
    this.canvas.width = width * ratio;
    this.canvas.height = height * ratio;
    const style = getComputedStyle(this.canvas);
    const to = this.canvas.getContext('2d', { willReadFrequently: true });
    to.scale(ratio, ratio);
    to.fillStyle = style.getPropertyValue('--stage');
    to.fillRect(0, 0, width, height);
    const column = (name) => ring.columns[ring.names.indexOf(name) + 1] ?? [];
    const [lat, latRest, lon, lonRest] = ['lat', 'lat_rest', 'lon', 'lon_rest'].map(column);
    const points = lat.map((value, row) => [value + latRest[row], lon[row] + lonRest[row]]).filter((each) => each.every(Number.isFinite));
    if (!ring.names.includes('lat') || !points.length) return;
    const placed = points.map(([north, east]) => mercator(north, east));
    const shrink = Math.cos(points.at(-1)[0] * RADIANS); // what a meter of the equator is here
    const [xs, ys] = [0, 1].map((axis) => placed.map((each) => each[axis]));
    const [left, right, bottom, top] = [xs.reduce((a, b) => Math.min(a, b)), xs.reduce((a, b) => Math.max(a, b)), ys.reduce((a, b) => Math.min(a, b)), ys.reduce((a, b) => Math.max(a, b))];
    const scale = Math.min(width / Math.max((right - left) * 1.25, LEAST_M / shrink), height / Math.max((top - bottom) * 1.25, LEAST_M / shrink)); // pixels a meter
    const [midX, midY] = [(left + right) / 2, (top + bottom) / 2];
    const at = ([x, y]) => [width / 2 + (x - midX) * scale, height / 2 - (y - midY) * scale];
    if (this.tiles) this.drawTiles(to, scale, midX, midY, width, height);
    const step = nice((60 / scale) * shrink) / shrink;
    to.strokeStyle = style.getPropertyValue(this.tiles ? '--grid-strong' : '--grid');
    to.lineWidth = 1;
    to.beginPath();
    for (let x = Math.ceil((midX - width / 2 / scale) / step) * step; x < midX + width / 2 / scale; x += step) {
      to.moveTo(at([x, 0])[0], 0);
      to.lineTo(at([x, 0])[0], height);
    }
    for (let y = Math.ceil((midY - height / 2 / scale) / step) * step; y < midY + height / 2 / scale; y += step) {
      to.moveTo(0, at([0, y])[1]);
      to.lineTo(width, at([0, y])[1]);
    }
    to.stroke();
    to.strokeStyle = to.fillStyle = style.getPropertyValue('--accent');
    to.lineWidth = 2.2;
    to.lineJoin = to.lineCap = 'round';
    to.beginPath();
    for (const point of placed) to.lineTo(...at(point));
    to.stroke();
    const error = column('error').at(-1);
    const here = at(placed.at(-1));
    if (Number.isFinite(error)) {
      to.globalAlpha = 0.15;
      to.beginPath();
      to.arc(...here, Math.min(2000, (error / shrink) * scale), 0, 7);
      to.fill();
      to.globalAlpha = 1;
    }
    to.beginPath();
    to.arc(...here, 5, 0, 7);
    to.fill();
    to.fillStyle = style.getPropertyValue('--soft');
    to.font = '11px system-ui, sans-serif';
    to.fillText(`grid ${step * shrink >= 999 ? `${(step * shrink) / 1000} km` : `${Number((step * shrink).toPrecision(3))} m`}, north up`, 10, height - 10);
  }

  drawTiles(to, scale, midX, midY, width, height) {
    const around = 2 * Math.PI * EARTH_M;
    const zoom = Math.max(0, Math.min(DEEPEST, Math.round(Math.log2((scale * around) / TILE))));
    const size = around / 2 ** zoom; // meters a tile
    const column = (x) => Math.floor((x + around / 2) / size);
    const row = (y) => Math.floor((around / 2 - y) / size);
    for (let x = column(midX - width / 2 / scale); x <= column(midX + width / 2 / scale); x += 1) {
      for (let y = row(midY + height / 2 / scale); y <= row(midY - height / 2 / scale); y += 1) {
        if (x < 0 || y < 0 || x >= 2 ** zoom || y >= 2 ** zoom) continue;
        const picture = this.picture(this.tiles.replace('{z}', zoom).replace('{x}', x).replace('{y}', y));
        const left = width / 2 + (x * size - around / 2 - midX) * scale;
        const top = height / 2 - (around / 2 - y * size - midY) * scale;
        if (picture.complete && picture.naturalWidth) to.drawImage(picture, left, top, size * scale + 0.5, size * scale + 0.5);
      }
    }
  }

  picture(url) {
    const known = this.pictures.get(url);
    if (known) return known;
    if (this.pictures.size > MOST_TILES) this.pictures.delete(this.pictures.keys().next().value);
    const picture = new Image();
    picture.src = url;
    this.pictures.set(url, picture);
    return picture;
  }
}
