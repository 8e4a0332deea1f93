"use strict";
// The views of the scene: a click picks the nearest camera, and lines lead to the images that share points with it.
function startScene(payload, table) {
  const SVG = "http://www.w3.org/2000/svg", NEAR = 24;
  const place = new Map(); // of a row of the table: its view, and its number there
  const views = payload.views.map((data, v) => data && { data, v, picked: -1, box: document.querySelector(`details[data-view="${v}"]`) });
  const made = (tag, values) => {
    const element = document.createElementNS(SVG, tag);
    for (const [name, value] of Object.entries(values)) element.setAttribute(name, value);
    return element;
  };
  const at = (data, side, i) => [data[side][2 * i], data[side][2 * i + 1]];
  const isThere = (data, i) => data.top[2 * i] !== null;
  const called = (data, i) => (data.rows[i] < 0 ? "an image that is not on this page" : table.name(data.rows[i]));

  function words(data, i) {
    const [count, ...near] = data.near[i];
    const verdict = data.rows[i] < 0 ? "" : `, ${table.verdict(data.rows[i])}`;
    const first = [];
    for (let k = 0; k < Math.min(near.length, 8); k += 2) first.push(`${called(data, near[k])} (${near[k + 1]})`);
    const most = first.length ? `; most with ${first.join(", ")}` : "";
    return `${called(data, i)}${verdict}. It shares points with ${count} image${count === 1 ? "" : "s"}${most}.`;
  }

  function pick(view, i) {
    const { data, box } = view;
    view.picked = i;
    const near = data.near[i].slice(1);
    for (const side of ["top", "side"]) {
      const group = box.querySelector(`.${side} .picked`);
      const [x, y] = at(data, side, i);
      const parts = [];
      for (let k = 0; k < near.length; k += 2) {
        if (!isThere(data, near[k])) continue;
        const [a, b] = at(data, side, near[k]);
        const width = 0.6 + 2.6 * Math.sqrt(near[k + 1] / near[1]);
        parts.push(made("line", { x1: x, y1: y, x2: a, y2: b, "stroke-width": width.toFixed(1) }), made("circle", { class: "mate", cx: a, cy: b, r: 5 }));
      }
      group.replaceChildren(...parts, made("circle", { cx: x, cy: y, r: 8 }));
    }
    box.querySelector(".picked-words").textContent = words(data, i);
    box.querySelector('[data-step="0"]').disabled = data.rows[i] < 0;
  }

  for (const view of views) {
    if (!view) continue;
    const { data, box } = view;
    data.rows.forEach((row, i) => { if (row >= 0 && isThere(data, i)) place.set(row, [view, i]); });
    const order = data.rows.map((row, i) => [row < 0 ? Infinity : row, i]).filter(([, i]) => isThere(data, i)).sort((a, b) => a[0] - b[0]).map(([, i]) => i);
    for (const side of ["top", "side"]) {
      const svg = box.querySelector(`.${side} svg`);
      svg.addEventListener("click", (event) => {
        const point = new DOMPoint(event.clientX, event.clientY).matrixTransform(svg.getScreenCTM().inverse());
        let best = -1, nearest = NEAR * NEAR;
        for (const i of order) {
          const [x, y] = at(data, side, i);
          const distance = (x - point.x) ** 2 + (y - point.y) ** 2;
          if (distance < nearest) [best, nearest] = [i, distance];
        }
        if (best >= 0) pick(view, best);
      });
    }
    box.querySelector(".walk").addEventListener("click", (event) => {
      const button = event.target.closest("button");
      if (!button || !order.length) return;
      const step = Number(button.dataset.step);
      if (!step) { table.open(data.rows[view.picked]); return; }
      const now = order.indexOf(view.picked);
      pick(view, order[now < 0 ? (step > 0 ? 0 : order.length - 1) : (now + step + order.length) % order.length]);
    });
  }
  return {
    has: (row) => place.has(row),
    show: (row) => {
      const [view, i] = place.get(row);
      view.box.open = true;
      pick(view, i);
      view.box.scrollIntoView();
      view.box.querySelector("summary").focus({ preventScroll: true });
    },
  };
}
