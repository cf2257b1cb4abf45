// A button on each block of code that copies it.
document.addEventListener("DOMContentLoaded", () => {
  for (const block of document.querySelectorAll("div.highlight")) {
    const button = Object.assign(document.createElement("button"), { className: "copy", textContent: "Copy" });
    button.onclick = () => navigator.clipboard.writeText(block.querySelector("pre").textContent.trimEnd());
    block.append(button);
  }
});
