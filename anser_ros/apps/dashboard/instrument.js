// The part of the page that moves: scene, table and curves. What it shows comes as arrays through
// its methods setup, frame, table, point and history; it asks for nothing itself.
import { OrbitControls, THREE } from "nicegui-scene";
import { echarts } from "nicegui-echart";

const COLOURS = [
  "#1f77b4", "#ff7f0e", "#2ca02c", "#d62728", "#9467bd", "#8c564b", "#e377c2", "#7f7f7f",
  "#bcbd22", "#17becf",
];
const BODY = "#111827"; // colour of a body, whose coils have those above
const LEVELS = ["ok", "warn", "bad", "bad"]; // of diagnostic_msgs
const ENLARGED = 10; // ellipsoids are drawn so many times their size
const TRAIL = 120; // places of a body that stay visible: ten seconds
const POINTS = 240; // of a curve, as the server keeps

const number = (value, digits) => (value === null ? "–" : value.toFixed(digits));
const colour = (target, rank) => (target.is_body ? BODY : COLOURS[rank % COLOURS.length]);

function pool(scene, make) {
  const items = [];
  return (count) => {
    while (items.length < count) {
      items.push(make());
      scene.add(items[items.length - 1]);
    }
    items.forEach((item, index) => (item.visible = index < count));
    return items;
  };
}

class Scene {
  constructor(box) {
    this.box = box;
    this.renderer = new THREE.WebGLRenderer({ antialias: true });
    this.renderer.setPixelRatio(Math.min(window.devicePixelRatio, 2));
    this.renderer.setClearColor("#f6f8fa");
    this.renderer.domElement.setAttribute("data-canvas", "scene");
    box.prepend(this.renderer.domElement);
    this.camera = new THREE.PerspectiveCamera(38, 1, 0.01, 20);
    this.camera.up.set(0, 0, 1);
    this.scene = new THREE.Scene();
    this.scene.add(new THREE.HemisphereLight("#ffffff", "#9aa4b2", 2.6));
    const sun = new THREE.DirectionalLight("#ffffff", 1.6);
    sun.position.set(1, -2, 3);
    this.scene.add(sun);
    this.controls = new OrbitControls(this.camera, this.renderer.domElement);
    this.controls.addEventListener("change", () => this.draw());
    this.controls.addEventListener("start", () => (this.seen = null));
    this.extent = new THREE.Box3();
    this.seen = null; // the view that follows the size of the panel, until somebody turns it
    this.fixed = new THREE.Group();
    this.moving = new THREE.Group();
    this.scene.add(this.fixed, this.moving);
    const metal = new THREE.MeshLambertMaterial({
      color: "#c2620f", transparent: true, opacity: 0.35, depthWrite: false,
    });
    const ball = new THREE.SphereGeometry(1, 12, 8);
    this.metal = pool(this.scene, () => new THREE.Mesh(ball, metal));
    this.size = 0.3;
    new ResizeObserver(() => this.fit()).observe(box);
    this.fit();
  }

  fit() {
    const { clientWidth: width, clientHeight: height } = this.box;
    if (!width || !height) return;
    this.renderer.setSize(width, height);
    this.camera.aspect = width / height;
    this.camera.updateProjectionMatrix();
    if (this.seen) this.look(this.seen);
    this.draw();
  }

  look(from) {
    const to = { space: [0.85, -1.35, 0.6], top: [0, -0.001, 1], front: [0, -1, 0.1], side: [1, 0, 0.1] };
    const way = new THREE.Vector3(...to[from]).normalize();
    const middle = this.extent.getCenter(new THREE.Vector3());
    this.seen = from;
    const stand = (target, far) => {
      this.controls.target.copy(target);
      this.camera.position.copy(target).addScaledVector(way, far);
      this.camera.lookAt(target);
      this.camera.updateMatrixWorld();
    };
    // As near as all corners of board and volume are in sight, their picture in the middle.
    for (let far = 0.2 * this.size; far < 20 * this.size; far *= 1.04) {
      stand(middle, far);
      const heights = this.corners().map((corner) => corner.project(this.camera).y);
      const high = (Math.max(...heights) + Math.min(...heights)) / 2 - 0.07; // above the key
      const up = new THREE.Vector3(0, 1, 0).applyQuaternion(this.camera.quaternion);
      const reach = far * Math.tan(THREE.MathUtils.degToRad(this.camera.fov / 2));
      stand(middle.clone().addScaledVector(up, high * reach), far);
      if (this.corners().every((corner) => this.isSeen(corner))) break;
    }
    this.controls.update();
    this.draw();
  }

  corners() {
    const { min, max } = this.extent;
    return [min.x, max.x].flatMap((x) => [min.y, max.y].flatMap((y) => [min.z, max.z].map((z) => new THREE.Vector3(x, y, z))));
  }

  isSeen(corner) {
    const { x, y, z } = corner.project(this.camera);
    return Math.abs(x) < 0.96 && y < 0.96 && y > -0.82 && z < 1; // below is the key
  }

  setup(world, targets) {
    for (const group of [this.fixed, this.moving]) group.clear();
    this.size = Math.max(0.1, world.reach_m * 2);
    this.unit = this.size / 100; // what small things are measured by
    const [x, y] = world.board_m;
    const [low, high] = world.volume_m;
    this.extent.set(new THREE.Vector3(-x, -y, 0), new THREE.Vector3(x, y, 0));
    this.extent.expandByPoint(new THREE.Vector3(...low)).expandByPoint(new THREE.Vector3(...high));
    this.board(world);
    this.targets = targets.map((target, rank) => this.target(target, colour(target, rank)));
    this.look("space");
  }

  line(points, shade, opacity = 1) {
    const geometry = new THREE.BufferGeometry().setFromPoints(points);
    const material = new THREE.LineBasicMaterial({ color: shade, transparent: true, opacity });
    return new THREE.Line(geometry, material);
  }

  board(world) {
    const [x, y] = world.board_m;
    const slab = new THREE.Mesh(
      new THREE.BoxGeometry(2 * x, 2 * y, 0.004),
      new THREE.MeshLambertMaterial({ color: "#dfe7ee" }),
    );
    slab.position.z = -0.003;
    this.fixed.add(slab);
    for (const [cx, cy, cz, turn, side] of world.coils) {
      for (const part of [1, 0.72, 0.44]) {
        const half = (part * side) / 2;
        const corners = [[1, 1], [-1, 1], [-1, -1], [1, -1], [1, 1]].map(([a, b]) => {
          const [u, v] = [a * half, b * half];
          return new THREE.Vector3(
            cx + u * Math.cos(turn) - v * Math.sin(turn), cy + u * Math.sin(turn) + v * Math.cos(turn), cz + 0.0005,
          );
        });
        this.fixed.add(this.line(corners, "#b7791f", 0.35 + 0.5 * part));
      }
    }
    const dot = new THREE.SphereGeometry(0.5 * this.unit, 10, 8);
    const grey = new THREE.MeshLambertMaterial({ color: "#64748b" });
    for (const [px, py, pz, ax, ay, az] of world.references) {
      const ball = new THREE.Mesh(dot, grey);
      ball.position.set(px, py, pz);
      const far = 2.2 * this.unit;
      const end = new THREE.Vector3(px + far * ax, py + far * ay, pz + far * az);
      this.fixed.add(ball, this.line([ball.position.clone(), end], "#64748b"));
    }
    const [low, high] = world.volume_m;
    const edges = new THREE.Box3Helper(
      new THREE.Box3(new THREE.Vector3(...low), new THREE.Vector3(...high)), "#c3ccd6",
    );
    this.fixed.add(edges);
    const axes = new THREE.AxesHelper(0.12 * this.size);
    axes.position.set(-x, -y, 0.001);
    this.fixed.add(axes);
  }

  target(target, shade) {
    const group = new THREE.Group();
    const paint = new THREE.MeshLambertMaterial({ color: shade });
    if (target.is_body) {
      group.add(new THREE.AxesHelper(7 * this.unit));
    } else {
      const coil = new THREE.Mesh(new THREE.CylinderGeometry(0.45 * this.unit, 0.45 * this.unit, 2.4 * this.unit, 14), paint);
      coil.rotation.x = Math.PI / 2;
      const tip = new THREE.Mesh(new THREE.ConeGeometry(0.8 * this.unit, 1.6 * this.unit, 14), paint);
      tip.rotation.x = Math.PI / 2;
      tip.position.z = 2 * this.unit;
      group.add(coil, tip);
    }
    const cloud = new THREE.Mesh(
      new THREE.SphereGeometry(1, 16, 12),
      new THREE.MeshLambertMaterial({ color: shade, transparent: true, opacity: 0.28, depthWrite: false }),
    );
    cloud.matrixAutoUpdate = false;
    const trail = target.is_body ? this.line([], BODY, 0.35) : null;
    group.visible = cloud.visible = false;
    this.moving.add(group, cloud);
    if (trail) this.moving.add(trail);
    return { group, cloud, trail, places: [] };
  }

  frame(rows) {
    rows.forEach((row, rank) => {
      const item = this.targets[rank];
      if (!item) return;
      item.group.visible = item.cloud.visible = row !== null;
      if (row === null) return;
      item.group.position.set(row[0], row[1], row[2]);
      item.group.quaternion.set(row[3], row[4], row[5], row[6]);
      const axes = [7, 10, 13].map((k) => new THREE.Vector3(row[k], row[k + 1], row[k + 2]).multiplyScalar(ENLARGED));
      item.cloud.matrix.makeBasis(...axes).setPosition(row[0], row[1], row[2]);
      if (!item.trail) return;
      item.places.push(new THREE.Vector3(row[0], row[1], row[2]));
      if (item.places.length > TRAIL) item.places.shift();
      item.trail.geometry.dispose();
      item.trail.geometry = new THREE.BufferGeometry().setFromPoints(item.places);
    });
    this.draw();
  }

  showMetal(balls) {
    this.metal(balls.length).forEach((ball, index) => {
      if (index >= balls.length) return;
      const [x, y, z, radius] = balls[index];
      ball.position.set(x, y, z);
      ball.scale.setScalar(radius);
    });
  }

  draw() {
    this.renderer.render(this.scene, this.camera);
  }
}

class Curves {
  constructor(box, unit) {
    this.chart = echarts.init(box, null, { renderer: "canvas" });
    this.unit = unit;
    this.data = [];
    new ResizeObserver(() => this.chart.resize()).observe(box);
  }

  setup(targets) {
    this.data = targets.map(() => []);
    this.marks = [];
    const text = { color: "#475569", fontSize: 11 };
    this.chart.setOption(
      {
        animation: false,
        grid: { left: 46, right: 14, top: 17, bottom: 22 },
        xAxis: { type: "time", axisLabel: { ...text, formatter: "{mm}:{ss}", hideOverlap: true }, splitLine: { show: true, lineStyle: { color: "#eef2f6" } } },
        yAxis: {
          type: "log", axisLabel: { ...text, formatter: (v) => `${+v.toPrecision(2)}` },
          splitLine: { lineStyle: { color: "#e2e8f0" } }, minorTick: { show: true },
        },
        tooltip: {
          trigger: "axis", confine: true, textStyle: { fontSize: 11 },
          valueFormatter: (v) => (v === null || v === undefined ? "–" : `${(+v).toPrecision(3)} ${this.unit}`),
        },
        series: targets.map((target, rank) => ({
          name: target.name, type: "line", showSymbol: false, data: [], connectNulls: false,
          lineStyle: { width: target.is_body ? 2.2 : 1.2, color: colour(target, rank) },
          itemStyle: { color: colour(target, rank) },
        })),
      },
      true,
    );
  }

  add(time, values) {
    this.data.forEach((curve, rank) => {
      const value = values[rank];
      curve.push([1e3 * time, value > 0 ? value : null]);
      if (curve.length > POINTS) curve.shift();
    });
  }

  show() {
    const lines = this.marks.map(([time, words]) => ({ xAxis: 1e3 * time, label: { formatter: words } }));
    const markLine = {
      symbol: "none", silent: true, data: lines, lineStyle: { color: "#0f766e", type: "solid" },
      label: { position: "end", distance: 2, fontSize: 10, color: "#0f766e" },
    };
    this.chart.setOption({
      series: this.data.map((curve, rank) => (rank ? { data: curve } : { data: curve, markLine })),
    });
  }
}

export default {
  template: `
    <div class="instrument">
      <section class="panel scene">
        <div class="views">
          <button v-for="v in ['space', 'top', 'front', 'side']" @click="look(v)">{{ v }}</button>
        </div>
        <div class="key">
          <span><i class="swatch" style="background:#b7791f"></i>emitters</span>
          <span><i class="swatch" style="background:#64748b"></i>references</span>
          <span><i class="swatch" style="background:#c2620f"></i>metal</span>
          <span>ellipsoids: 3 &sigma;, enlarged 10 times</span>
        </div>
        <div class="waiting"></div>
      </section>
      <section class="panel curve"><h2>Error by coil <small>distance to the optical pose, mm</small></h2><div class="chart" data-chart="error"></div></section>
      <section class="panel curve"><h2>Residual by coil <small>measured less modelled flux, pT</small></h2><div class="chart" data-chart="residual"></div></section>
      <section class="panel states"><div class="scroll"><table>
        <thead><tr><th>coil or body</th><th>state</th><th class="n">x</th><th class="n">y</th><th class="n">z mm</th>
        <th class="n">&sigma; mm</th><th class="n">error mm</th><th class="n">residual pT</th><th class="n">Hz</th></tr></thead>
        <tbody></tbody></table></div></section>
    </div>`,

  mounted() {
    this.frames = 0;
    this.targets = [];
    const find = (name) => this.$el.querySelector(name);
    this.scene = new Scene(find(".scene"));
    this.error = new Curves(find('[data-chart="error"]'), "mm");
    this.residual = new Curves(find('[data-chart="residual"]'), "pT");
    this.$emit("ready");
  },

  methods: {
    look(from) {
      this.scene.look(from);
    },

    setup(world) {
      this.targets = world.targets;
      this.scene.setup(world, world.targets);
      for (const curves of [this.error, this.residual]) curves.setup(world.targets);
      const body = this.$el.querySelector("tbody");
      body.replaceChildren();
      this.cells = world.targets.map((target, rank) => {
        const row = body.insertRow();
        row.dataset.target = target.name;
        const cells = Array.from({ length: 9 }, () => row.insertCell());
        const dot = document.createElement("i");
        dot.className = target.is_body ? "swatch square" : "swatch";
        dot.style.background = colour(target, rank);
        cells[0].append(dot, target.name);
        cells.slice(2).forEach((cell) => (cell.className = "n"));
        return cells;
      });
      for (const point of world.points) this.put(point);
      this.marks(world.marks);
    },

    frame(rows) {
      if (!this.targets.length) return;
      this.scene.frame(rows);
      rows.forEach((row, rank) => {
        for (const k of [0, 1, 2]) {
          const text = row === null ? "–" : (1e3 * row[k]).toFixed(1);
          const cell = this.cells[rank][2 + k];
          if (cell.textContent !== text) cell.textContent = text;
        }
      });
      this.frames += 1;
      this.$el.dataset.frames = this.frames;
      this.$el.dataset.poses = rows.filter((row) => row !== null).length;
    },

    table(rows, metal) {
      rows.forEach(([level, state, reason, sigma, error, residual, rate], rank) => {
        const cells = this.cells[rank];
        if (!cells) return;
        cells[1].replaceChildren();
        const pill = document.createElement("span");
        pill.className = `pill ${LEVELS[level]}`;
        pill.textContent = state;
        const why = document.createElement("span");
        why.className = "reason";
        why.textContent = reason;
        cells[1].append(pill, why);
        cells[1].parentNode.title = reason;
        cells[5].textContent = number(sigma, 2);
        cells[6].textContent = number(error, 2);
        cells[7].textContent = number(residual, 0);
        cells[8].textContent = number(rate, 0);
      });
      this.scene.showMetal(metal);
      this.$el.dataset.metal = metal.length;
    },

    put([time, error, residual]) {
      this.error.add(time, error);
      this.residual.add(time, residual);
    },

    point(values) {
      this.put(values);
      this.error.show();
      this.residual.show();
    },

    marks(found) {
      for (const curves of [this.error, this.residual]) {
        curves.marks = found;
        curves.show();
      }
    },
  },
};
