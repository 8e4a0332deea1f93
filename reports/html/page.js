"use strict";
// The columns of the page's table, the panel of an image, and their links with the scene.
(() => {
  const payload = JSON.parse(document.getElementById("payload").textContent);
  const byId = (id) => document.getElementById(id);
  const NAME = 0, CODES = 1, SENTENCES = 2, CAMERA = 3, SCENE = 4;
  const factIndex = new Map(payload.facts.map((fact, i) => [fact.name, payload.firstFact + i]));
  const at = (row, name) => row[factIndex.get(name)];

  function shown(value, kind) {
    if (value === null || value === undefined) return "-";
    if (kind === "p") return value >= 1e-3 || value === 0 ? String(+value.toPrecision(2)) : value.toExponential(0);
    if (kind === "px") return inPx(value);
    if (kind === "small") return value === 0 || Math.abs(value) >= 1e-3 ? String(+value.toPrecision(3)) : value.toExponential(1);
    if (kind === "number") return Math.abs(value) < 1000 ? value.toFixed(2) : value.toPrecision(3);
    return String(value);
  }
  const photo = (i) => (payload.thumbnails[i] ? `<img class="thumb" src="${payload.thumbnails[i]}" alt="">` : "");

  function cell(kind) {
    return (value, type, row) => {
      if (type !== "display") return kind === "codes" ? value.join(" ") : (value ?? (type === "filter" ? "" : null));
      const i = row[row.length - 1];
      if (kind === "name") return `<button type="button" class="open" data-row="${i}">${photo(i)}<bdi>${nameOr(value)}</bdi></button>`;
      if (kind === "verdict") return verdictBadge(value);
      if (kind === "codes") return escapeText(value.join(", ").replaceAll("_", " "));
      if (kind === "text") return `<bdi>${breakable(shown(value, kind))}</bdi>`;
      return escapeText(shown(value, kind));
    };
  }

  payload.rows.forEach((row, i) => row.push(i));
  const numeric = new Set(["count", "px", "number", "small", "p"]);
  const source = (column) => (column.name === "image_name" ? NAME : column.name === "codes" ? CODES : factIndex.get(column.name));
  const columns = payload.columns.map((column) => ({
    data: source(column),
    title: column.title,
    name: column.name,
    render: cell(column.kind),
    type: numeric.has(column.kind) ? "num" : "string",
    orderSequence: numeric.has(column.kind) ? ["desc", "asc"] : ["asc", "desc"],
    className: `${numeric.has(column.kind) ? "dt-type-numeric" : column.kind} rank-${column.rank}`,
  }));
  const { datasets, scenes, cameras } = payload;
  const labels = { reason: (value) => value.replaceAll("_", " "), scene: (value) => scenes[value], camera: (value) => cameras[value] };
  startTable({
    rows: payload.rows,
    columns,
    asks: {
      verdict: (row) => at(row, "verdict"),
      reason: (row) => row[CODES],
      dataset: (row) => datasets[row[SCENE]],
      scene: (row) => String(row[SCENE]),
      camera: (row) => String(row[CAMERA]),
    },
    words: (row) => `${row[NAME]} ${scenes[row[SCENE]]} ${row[CODES].join(" ")}`,
    label: (ask, value) => (labels[ask] ? labels[ask](value) : value),
  });

  const dialog = byId("panel");
  const text = (tag, content) => Object.assign(document.createElement(tag), { textContent: content });
  const name = (row) => row[NAME] || "(no name)";
  let opened = -1;
  function open(index) {
    opened = index;
    const row = payload.rows[index];
    byId("panel-title").textContent = name(row);
    const verdict = at(row, "verdict");
    byId("panel-verdict").replaceChildren(Object.assign(text("span", verdict), { className: `badge ${verdict}` }));
    byId("panel-reasons").replaceChildren(...row[SENTENCES].map((sentence) => text("li", sentence)));
    byId("panel-pictures").hidden = index >= payload.numPictures;
    byId("panel-pictures").href = `#worst-${index}`;
    byId("panel-scene").hidden = !window.scene.has(index);
    const picture = Object.assign(new Image(), { src: payload.thumbnails[index] ?? "", alt: `Photo of ${name(row)}` });
    byId("panel-photo").replaceChildren(...(payload.thumbnails[index] ? [picture] : []));
    byId("panel-facts").replaceChildren(...payload.facts.map((fact, i) => {
      const line = document.createElement("tr");
      const value = row[payload.firstFact + i];
      const unit = fact.unit === "px" && value !== null ? " px" : "";
      const head = Object.assign(text("th", fact.name), { scope: "row" });
      line.append(head, text("td", value === null ? "-" : String(value) + unit), text("td", fact.meaning));
      return line;
    }));
    dialog.showModal();
    dialog.scrollTop = 0;
  }
  window.scene = startScene(payload, { open, name: (index) => name(payload.rows[index]), verdict: (index) => at(payload.rows[index], "verdict") });
  document.addEventListener("click", (event) => {
    const link = event.target.closest("[data-row].open");
    if (!link) return;
    open(Number(link.dataset.row));
    event.preventDefault();
  });
  byId("panel-pictures").addEventListener("click", (event) => {
    const target = document.querySelector(event.target.getAttribute("href"));
    dialog.close();
    if (target) { target.open = true; target.querySelector("summary").focus(); target.scrollIntoView(); }
    event.preventDefault();
  });
  byId("panel-scene").addEventListener("click", (event) => { dialog.close(); window.scene.show(opened); event.preventDefault(); });
  dialog.addEventListener("click", (event) => { if (event.target === dialog) dialog.close(); });

  document.documentElement.dataset.ready = "true";
})();
