"use strict";
// The table of the page of `diff`, and its filters. All texts of the runs reach the page as text nodes or escaped.
(() => {
  const payload = JSON.parse(document.getElementById("payload").textContent);
  const byId = (id) => document.getElementById(id);
  const NAME = 0, SCENE = 1, KINDS = 2, REMARK = 8, MAX_OPTIONS = 500, MAX_PRINTED = 500;
  const escape = (text) => String(text).replace(/[&<>"']/g, (c) => `&#${c.charCodeAt(0)};`);
  const isVerdict = new Set(["accepted", "rejected", "undetermined"]);
  const looks = {
    name: (value) => `<bdi>${escape(value) || "(no name)"}</bdi>`,
    text: (value) => `<bdi>${escape(value).replaceAll("_", "_<wbr>")}</bdi>`,
    kinds: (value) => escape(value.join(", ")),
    verdict: (value) => (isVerdict.has(value) ? `<span class="badge ${value}">${value}</span>` : escape(value)),
    px: (value) => (value === null ? "-" : Math.abs(value) < 1000 ? value.toFixed(3) : value.toPrecision(3)),
  };
  const column = (title, kind, rank) => ({
    title,
    type: kind === "px" ? "num" : "string",
    className: `${kind === "px" ? "dt-type-numeric" : kind} rank-${rank}`,
    render: (value, type) => (type === "display" ? looks[kind](value) : Array.isArray(value) ? value.join(" ") : value),
  });
  const columns = [
    column("Image", "name", 0), column("Scene", "text", 1), column("Change", "kinds", 0), column("Before", "verdict", 1), column("Now", "verdict", 0),
    column("Noise before, px", "px", 2), column("Noise now, px", "px", 2), column("Growth, px", "px", 2), column("Remark", "text", 1),
  ];
  columns.forEach((each, i) => { each.data = i; });
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

  const asks = { kind: (row) => row[KINDS], scene: (row) => [row[SCENE]] };
  const selects = Object.fromEntries(Object.keys(asks).map((ask) => [ask, byId(`filter-${ask}`)]));
  for (const [ask, select] of Object.entries(selects)) {
    const found = [...new Set(payload.rows.flatMap(asks[ask]))].sort((a, b) => a.localeCompare(b, undefined, { numeric: true }));
    if (found.length <= MAX_OPTIONS) for (const value of found) select.add(new Option(value, value));
    select.parentElement.hidden = found.length < 2 || found.length > MAX_OPTIONS;
  }
  const form = byId("filters");
  function filter() {
    const words = byId("filter-text").value.toLowerCase().split(/\s+/).filter(Boolean);
    const wanted = Object.entries(selects).filter(([, select]) => select.value);
    table.search.fixed("filters", (_, row) =>
      wanted.every(([ask, select]) => asks[ask](row).includes(select.value)) &&
      words.every((word) => `${row[NAME]} ${row[SCENE]} ${row[REMARK]}`.toLowerCase().includes(word)));
    table.draw();
  }
  let waiting;
  form.addEventListener("input", () => { clearTimeout(waiting); waiting = setTimeout(filter, 120); });
  form.addEventListener("submit", (event) => { event.preventDefault(); filter(); });
  form.addEventListener("reset", () => setTimeout(filter));
  document.addEventListener("click", (event) => {
    const link = event.target.closest("a.ask");
    if (!link) return;
    const select = selects[link.dataset.ask], value = link.dataset.value;
    form.reset();
    if (![...select.options].some((option) => option.value === value)) select.add(new Option(value, value));
    select.value = value;
    select.parentElement.hidden = false;
    setTimeout(filter);
    event.preventDefault();
    byId("images-heading").scrollIntoView();
    byId("images-heading").focus({ preventScroll: true });
  });
  let length = 25;
  window.addEventListener("beforeprint", () => { length = table.page.len(); table.page.len(MAX_PRINTED).draw(); });
  window.addEventListener("afterprint", () => { table.page.len(length).draw(); });
  document.documentElement.dataset.ready = "true";
})();
