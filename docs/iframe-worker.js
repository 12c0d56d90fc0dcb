// Search in a site that is opened from disk. A browser starts no Worker from file://, so here a
// hidden frame plays its part, as far as the theme's search needs one: messages both ways.
if (location.protocol === "file:")
  window.Worker = class extends EventTarget {
    constructor(url) {
      super()
      const frame = document.createElement("iframe")
      frame.hidden = true
      frame.srcdoc = "<!DOCTYPE html>"
      this.inside = new Promise(resolve =>
        frame.addEventListener("load", () => {
          const inside = frame.contentWindow
          inside.postMessage = data => this.dispatchEvent(new MessageEvent("message", { data }))
          const script = inside.document.createElement("script")
          script.src = new URL(url, location.href)
          script.addEventListener("load", () => resolve(inside))
          inside.document.body.append(script)
        }, { once: true }))
      this.terminate = () => frame.remove()
      document.body.append(frame)
    }
    postMessage(data) {
      this.inside.then(inside => inside.dispatchEvent(new MessageEvent("message", { data })))
    }
  }
