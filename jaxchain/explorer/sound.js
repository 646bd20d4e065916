// One motion is repeated without a seam: whole turns of the velocity, at the frequency wanted.
if (!on.active) return
const v = Float32Array.from(cb_obj.get_column('v')), rate = cb_obj.get_column('rate')[0] * base.value
if (v.length < 8 || !(rate > 0)) return
const audio = window.squeal ??= new AudioContext()
const buffer = audio.createBuffer(1, v.length, 44100), source = audio.createBufferSource()
buffer.copyToChannel(v, 0)
source.buffer = buffer; source.loop = true; source.playbackRate.value = rate / 44100
const gain = audio.createGain(), now = audio.currentTime
gain.gain.setValueAtTime(0, now); gain.gain.linearRampToValueAtTime(0.2, now + 0.05)
gain.gain.setValueAtTime(0.2, now + 0.45); gain.gain.linearRampToValueAtTime(0, now + 0.55)
source.connect(gain).connect(audio.destination); source.start(now); source.stop(now + 0.6)
