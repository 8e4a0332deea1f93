"use strict";
// The table of the page of `diff`: what stands in its columns.
(() => {
  const payload = JSON.parse(document.getElementById("payload").textContent);
  const NAME = 0, SCENE = 1, KINDS = 2, REMARK = 8;
  const looks = {
    name: (value) => `<bdi>${nameOr(value)}</bdi>`,
    text: (value) => `<bdi>${breakable(value)}</bdi>`,
    kinds: (value) => escapeText(value.join(", ")),
    verdict: verdictBadge,
    px: (value) => (value === null ? "-" : inPx(value)),
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
  startTable({
    rows: payload.rows,
    columns,
    asks: { kind: (row) => row[KINDS], scene: (row) => row[SCENE] },
    words: (row) => `${row[NAME]} ${row[SCENE]} ${row[REMARK]}`,
  });
  document.documentElement.dataset.ready = "true";
})();
