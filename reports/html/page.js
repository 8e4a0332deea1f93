"use strict";
// Connects the rows of this page with DataTables, the filters, the panel and the scene. All texts of the run reach the
// page as text nodes or escaped.
(() => {
  const payload = JSON.parse(document.getElementById("payload").textContent);
  const byId = (id) => document.getElementById(id);
  const NAME = 0, CODES = 1, SENTENCES = 2, CAMERA = 3, SCENE = 4, MAX_OPTIONS = 500, MAX_PRINTED = 500;
  const factIndex = new Map(payload.facts.map((fact, i) => [fact.name, payload.firstFact + i]));
  const at = (row, name) => row[factIndex.get(name)];
  const escape = (text) => String(text).replace(/[&<>"']/g, (c) => `&#${c.charCodeAt(0)};`);
  const digits = { px: 3, number: 2 };

  function shown(value, kind) {
    if (value === null || value === undefined) return "-";
    if (kind === "p") return value >= 1e-3 || value === 0 ? String(+value.toPrecision(2)) : value.toExponential(0);
    if (kind in digits) return Math.abs(value) < 1000 ? value.toFixed(digits[kind]) : value.toPrecision(3);
    return String(value);
  }
  const photo = (i) => (payload.thumbnails[i] ? `<img class="thumb" src="${payload.thumbnails[i]}" alt="">` : "");

  function cell(kind) {
    return (value, type, row) => {
      if (type !== "display") return kind === "codes" ? value.join(" ") : (value ?? (type === "filter" ? "" : null));
      const i = row[row.length - 1];
      if (kind === "name") return `<button type="button" class="open" data-row="${i}">${photo(i)}<bdi>${escape(value) || "(no name)"}</bdi></button>`;
      if (kind === "verdict") return `<span class="badge ${escape(value)}">${escape(value)}</span>`;
      if (kind === "codes") return escape(value.join(", ").replaceAll("_", " "));
      if (kind === "text") return `<bdi>${escape(shown(value, kind)).replaceAll("_", "_<wbr>")}</bdi>`;
      return escape(shown(value, kind));
    };
  }

  payload.rows.forEach((row, i) => row.push(i));
  const numeric = new Set(["count", "px", "number", "p"]);
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
  const table = new DataTable("#images", {
    data: payload.rows,
    columns,
    order: [],
    autoWidth: false,
    deferRender: true,
    pageLength: 25,
    layout: { topStart: "info", topEnd: "pageLength", bottomStart: null, bottomEnd: "paging" },
  });

  const scroller = byId("images").closest(".dt-layout-table");
  for (const [name, value] of [["role", "region"], ["tabindex", "0"], ["aria-label", "Table of images"]]) scroller.setAttribute(name, value);

  // filters: each asks one thing of a row
  const asks = {
    verdict: (row) => at(row, "verdict"),
    reason: (row) => row[CODES],
    dataset: (row) => datasets[row[SCENE]],
    scene: (row) => String(row[SCENE]),
    camera: (row) => String(row[CAMERA]),
  };
  const datasets = payload.datasets;
  const labels = { reason: (value) => value.replaceAll("_", " "), scene: (value) => payload.scenes[value], camera: (value) => payload.cameras[value] };
  const label = (ask, value) => (labels[ask] ? labels[ask](value) : value);
  const selects = Object.fromEntries(Object.keys(asks).map((ask) => [ask, byId(`filter-${ask}`)]));
  for (const [ask, select] of Object.entries(selects)) {
    const found = [...new Set(payload.rows.flatMap(asks[ask]))].map((value) => [label(ask, value), value]);
    found.sort((a, b) => a[0].localeCompare(b[0], undefined, { numeric: true }));
    if (found.length <= MAX_OPTIONS) for (const [text, value] of found) select.add(new Option(text, value));
    select.parentElement.hidden = found.length < 2 || found.length > MAX_OPTIONS;
  }

  function filter() {
    const words = byId("filter-text").value.toLowerCase().split(/\s+/).filter(Boolean);
    const wanted = Object.entries(selects).filter(([, select]) => select.value).map(([ask, select]) => [asks[ask], select.value]);
    table.search.fixed("filters", (_, row) =>
      wanted.every(([ask, value]) => { const has = ask(row); return Array.isArray(has) ? has.includes(value) : has === value; }) &&
      words.every((word) => `${row[NAME]} ${payload.scenes[row[SCENE]]} ${row[CODES].join(" ")}`.toLowerCase().includes(word)));
    table.draw();
  }
  function choose(ask, value) {
    form.reset();
    const select = selects[ask];
    if (![...select.options].some((option) => option.value === value)) select.add(new Option(label(ask, value), value));
    select.value = value;
    select.parentElement.hidden = false;
    setTimeout(filter); // after the form's own reset
  }
  const form = byId("filters");
  let waiting;
  form.addEventListener("input", () => { clearTimeout(waiting); waiting = setTimeout(filter, 120); });
  form.addEventListener("submit", (event) => { event.preventDefault(); filter(); });
  form.addEventListener("reset", () => setTimeout(filter));
  document.addEventListener("click", (event) => {
    const link = event.target.closest("a.ask");
    if (!link) return;
    choose(link.dataset.ask, link.dataset.value);
    event.preventDefault();
    byId("images-heading").scrollIntoView();
    byId("images-heading").focus({ preventScroll: true });
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
  byId("images").addEventListener("click", (event) => {
    const button = event.target.closest("button.open");
    if (button) open(Number(button.dataset.row));
  });
  byId("panel-pictures").addEventListener("click", (event) => {
    const target = document.querySelector(event.target.getAttribute("href"));
    dialog.close();
    if (target) { target.open = true; target.querySelector("summary").focus(); target.scrollIntoView(); }
    event.preventDefault();
  });
  byId("panel-scene").addEventListener("click", (event) => { dialog.close(); window.scene.show(opened); event.preventDefault(); });
  dialog.addEventListener("click", (event) => { if (event.target === dialog) dialog.close(); });

  // paper shows what is open on the screen, and the rows that the filters leave
  let length = 25;
  window.addEventListener("beforeprint", () => { length = table.page.len(); table.page.len(MAX_PRINTED).draw(); });
  window.addEventListener("afterprint", () => { table.page.len(length).draw(); });
  document.documentElement.dataset.ready = "true";
})();
