// All pictures below each other, as they are.
const shots = []
for (const view of Object.values(Bokeh.index).flatMap(function all(view) {
    return [...(view.model.type == "Figure" ? [view] : []),
            ...(view.child_views ?? []).flatMap(all)]})) shots.push(view.export("png").canvas)
const page = document.createElement("canvas"), pen = page.getContext("2d")
page.width = Math.max(...shots.map(s => s.width))
page.height = shots.reduce((sum, s) => sum + s.height, 0)
pen.fillStyle = "white"; pen.fillRect(0, 0, page.width, page.height)
let y = 0
for (const shot of shots) { pen.drawImage(shot, 0, y); y += shot.height }
const link = document.createElement("a")
link.download = "explorer.png"; link.href = page.toDataURL("image/png"); link.click()
